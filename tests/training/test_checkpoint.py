"""A run that goes on from its checkpoint, and what is none of its own."""

from __future__ import annotations

import pytest
import torch
from examples import drives, example
from training_runs import Scripted, Stopping, Wrong, run, same, values

from steady_ppl import (
    Optimization,
    RunError,
)
from steady_ppl.training.checkpoint import Checkpoint
from steady_ppl.training.loop import _judge
from steady_ppl.utils.tensor_files import read_tensors


@pytest.mark.slow
@pytest.mark.parametrize("batch", [None, 2])
@pytest.mark.parametrize("stop", [1, 3, 4, 5])
def test_a_resumed_run_repeats_an_uninterrupted_one_bit_for_bit(data, tmp_path, stop, batch):
    optimization = Optimization(steps=6, validate_every=2, learning_rate=0.05, batch=batch, gradient_steps=2)
    whole, killed, resumed = Wrong(), Wrong(), Wrong()
    a = run(whole, data, optimization, checkpoint=tmp_path / "whole", seed=1)
    guide = Stopping(killed, at=stop, error=RuntimeError("killed"))
    with pytest.raises(RuntimeError, match="killed"):
        run(killed, data, optimization, guide=guide, checkpoint=tmp_path / "cut", seed=1)
    guide = Stopping(resumed)
    b = run(resumed, data, optimization, guide=guide, checkpoint=tmp_path / "cut", resume=True, seed=1)
    assert len(guide.seen) == 6 - stop // 2 * 2  # it went on from the last checkpoint, not from the beginning
    assert a == b
    assert same(values(whole), values(resumed))
    left = [read_tensors(tmp_path / name) for name in ("whole", "cut")]
    assert same(left[0][0], left[1][0]) and left[0][1] == left[1][1]


def test_a_resumed_run_keeps_counting_the_patience(data, tmp_path):
    scores = ((5.0,), (4.0,), (3.0,), (2.0,), (1.0,))
    optimization = Optimization(steps=10, validate_every=2, patience=3, learning_rate=0.05)
    whole, killed, resumed = Wrong(), Wrong(), Wrong()
    a = run(whole, data, optimization, validation=Scripted(data, scores=scores))
    guide, script = Stopping(killed, at=5, error=RuntimeError("killed")), Scripted(data, scores=scores)
    with pytest.raises(RuntimeError, match="killed"):
        run(killed, data, optimization, guide=guide, validation=script, checkpoint=tmp_path / "cut")
    rest = Scripted(data, scores=scores[2:])
    guide = Stopping(resumed)
    b = run(resumed, data, optimization, guide=guide, validation=rest, checkpoint=tmp_path / "cut", resume=True)
    assert (a.kept, a.history[-1]["step"]) == (b.kept, b.history[-1]["step"]) == (2, 8)
    assert same(values(whole), values(resumed))


def test_resuming_a_finished_run_changes_nothing(data, tmp_path):
    program, again = Wrong(), Wrong()
    a = run(program, data, checkpoint=tmp_path / "done")
    written = (tmp_path / "done").read_bytes()
    b = run(again, data, checkpoint=tmp_path / "done", resume=True)
    assert a == b and same(values(program), values(again))
    assert (tmp_path / "done").read_bytes() == written


def test_resuming_needs_a_checkpoint_of_the_same_program(data, tmp_path):
    with pytest.raises(RunError, match="no file"):
        run(Wrong(), data, checkpoint=tmp_path / "nothing", resume=True)
    run(Wrong(), data, checkpoint=tmp_path / "cart")
    pendulum = example("pendulum", torch.float32)
    with pytest.raises(RunError, match="other parameters"):
        run(pendulum, drives(pendulum, 2, 6), checkpoint=tmp_path / "cart", resume=True)
    (tmp_path / "cart").write_bytes((tmp_path / "cart").read_bytes()[:-50])
    with pytest.raises(RunError, match="damaged"):
        run(Wrong(), data, checkpoint=tmp_path / "cart", resume=True)


def test_a_checkpoint_of_other_validation_drives_is_refused():
    with pytest.raises(RunError, match=r"it has 2 held-out log p\(y\), and there are 1"):
        _judge(Checkpoint({}, {}, {}, step=4, best_held_out=[1.0, 2.0]), [1.5], {})
