"""Figures of two published logs: what is compared with what."""

from __future__ import annotations

import math

import pytest
import real
import torch
from small import MODELS


def test_a_map_is_moved_and_turned_but_neither_mirrored_nor_stretched():
    true = torch.tensor([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [1.0, 5.0]], dtype=torch.float64)
    c, s = math.cos(2.0), math.sin(2.0)
    turned = true @ torch.tensor([[c, -s], [s, c]], dtype=torch.float64) + torch.tensor([7.0, -9.0])
    assert real.off_when_aligned(turned, true) < 1e-9
    assert real.off_when_aligned(true * torch.tensor([-1.0, 1.0]), true) > 0.5
    centred = true - true.mean(0)
    assert real.off_when_aligned(1.1 * true, true) == pytest.approx(0.1 * float(centred.square().sum(-1).mean().sqrt()))


def test_figures_of_a_program_are_those_that_motion_capture_has(tmp_path):
    (tmp_path / "mrclam").mkdir()
    (tmp_path / "mrclam" / "robot.py").write_text(
        "from steady_ppl import load_program\n"
        f"class Robot(type(load_program({str(MODELS / 'unicycle.py')!r}))):\n    landmarks = ((1.0, 2.0), (3.0, 4.0))\n"
    )
    program = real.robot(real.KnownRobot, tmp_path)
    found = real.captured(program, real.sizes_of(program))
    assert found.keys() == real.CAPTURED.keys() and found["speed gain"] == 1.0
    assert found["turn response, s"] == pytest.approx(0.1 + program.settling)
    assert found["sd of a range at 6 m, m"] == pytest.approx(0.09 * 0.5 * 1.6)
    unknown = real.robot(real.KnownRobot, tmp_path, real.UnknownMap)
    with torch.no_grad():
        unknown.map += 1.0
    assert torch.equal(unknown.landmarks, torch.tensor([[2.0, 3.0], [4.0, 5.0]]))
    plain = real.robot(real.Robot, tmp_path)
    assert real.captured(plain, {"lever_arm": 1.0}).keys() == {"speed gain", "turn gain"}


def test_a_figure_is_near_where_it_has_the_sign_and_a_quarter_is_not_missing():
    assert real.is_near("range scale", -0.015) and not real.is_near("range scale", 0.019)
    assert not real.is_near("bearing bias, rad", -0.0242)
