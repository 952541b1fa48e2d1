"""The probe: each way in which a program can be wrong is named before anything long starts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from steady_ppl import ProgramError, for_program, load_program, log_likelihood, simulate
from steady_ppl.model.program import Program
from steady_ppl.model.validate import probe

BOAT = """\
import pyro
import pyro.distributions as dist
import torch
from pyro.nn import PyroParam
from torch import tensor

from steady_ppl import Program, stack


class Boat(Program):
    states = ("x [m]", "v [m/s]")
    controls = ("push [N]",)
    measurements = ("x [m]", "v [m/s]")
    channels = ("push [m/s²]",)

    def __init__(self):
        super().__init__()
        self.noise = PyroParam(tensor(0.5))

    def initial(self):
        return pyro.sample("start", dist.Normal(torch.zeros(2), torch.ones(2)).to_event(1))

    def transition(self, state, control, time, step):
        x, v = state.unbind(-1)
        a = pyro.sample("push", dist.Normal(control[..., 0], self.noise))
        return stack(x + v * step, v + a * step)

    def observe(self, state):
        pyro.sample("seen", dist.Normal(state, 0.1).to_event(1))
"""

START, MOVE, SEEN = (
    "dist.Normal(torch.zeros(2), torch.ones(2)).to_event(1)",
    "stack(x + v * step, v + a * step)",
    "dist.Normal(state, 0.1).to_event(1)",
)
NOISE = "dist.Normal(control[..., 0], self.noise)"
OBSERVE = f'pyro.sample("seen", {SEEN})'


def boat(folder: Path, *changes: tuple[str, str]) -> Program:
    """The boat with some text replaced."""
    text = BOAT
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    (folder / "boat.py").write_text(text)
    return load_program(folder / "boat.py")


def test_the_boat_as_it_stands_is_a_program(tmp_path: Path) -> None:
    probe(boat(tmp_path))


def changed(old: str, new: str, site: str | None, *says: str, id: str):
    return pytest.param((old, new), site, says, id=id)


WRONG = [
    changed("def initial", "def begin", "initial", "Boat lacks the method initial(self)", id="no initial"),
    changed("def transition", "def move", "transition", "lacks the method transition(self, state,", id="no transition"),
    changed("def observe", "def see", "observe", "Boat lacks the method observe(self, state)", id="no observe"),
    changed(
        "(self, state, control, time, step)", "(self, state)", "transition", "transition() takes 2", id="arguments"
    ),
    changed("return pyro", "pyro", "initial", "the 2 declared components", "NoneType", id="initial returns nothing"),
    changed(f"return {MOVE}", "pass", "transition", "the 2 declared components", "NoneType", id="no next state"),
    changed(START, START.replace("2", "3"), "initial", "the 2 declared", "(7, 1, 13, 3)", id="start too wide"),
    changed(MOVE, "state[..., :1]", "transition", "the 2 declared", "(7, 11, 13, 1)", id="next state too narrow"),
    changed(MOVE, f"({MOVE[6:]}", "transition", "the 2 declared", "tuple", id="next state a tuple"),
    changed(
        MOVE, f"torch.{MOVE[:6]}[{MOVE[6:-1]}])", "transition", "the 2 declared", "(2, 7, 11, 13)", id="component first"
    ),
    changed(MOVE, f"{MOVE}.sum()", "transition", "the 2 declared", "shape ()", id="next state summed to a number"),
    changed(MOVE, f"{MOVE}.sum(0)", "transition", "(11, 13, 2)", "(7, 11, 13, 2)", id="next state summed over draws"),
    changed(MOVE, f"{MOVE}[0]", "transition", "(11, 13, 2)", "(7, 11, 13, 2)", id="one draw only"),
    changed(f'pyro.sample("push", {NOISE})', "control[..., 0]", "transition", "samples nothing", id="no noise"),
    changed(".unbind(-1)", ".unbind(0)", "transition", "too many values to unpack", id="unbound on the left"),
    changed("control[..., 0]", "control[..., 1]", "transition", "IndexError", "(7, 11, 13)", id="no such control"),
    changed("tensor(0.5)", "tensor(-0.5)", "transition", "scale", "GreaterThan", id="negative deviation"),
    changed(
        SEEN, "dist.Normal(state[..., 0], 0.1)", "observe", "sampled 1", "declares 2", id="one measurement too few"
    ),
    changed(
        SEEN, "dist.Normal(state[..., [0, 0, 1]], 0.1).to_event(1)", "seen", "(3,)", "2 declared", id="one too many"
    ),
    changed(SEEN, "dist.Normal(state, 0.1).to_event(2)", "seen", "(13, 2)", "a scalar or a vector", id="event too big"),
    changed(OBSERVE, "pass", "observe", "sampled 0", "declares 2", id="nothing measured"),
    changed("    channels", "    error_groups = {'way': ('z',)}\n    channels", None, "error_groups", id="error group"),
    changed("    channels", "    resting = ('z [m]',)\n    channels", None, "resting names 'z'", id="resting"),
    changed('    states = ("x [m]", "v [m/s]")', "", None, "declares no states", id="no states"),
    changed('    measurements = ("x [m]", "v [m/s]")', "", None, "declares no measurements", id="no measurements"),
]


@pytest.mark.parametrize(("change", "site", "says"), WRONG)
def test_what_does_not_fit_is_named(tmp_path: Path, change, site: str | None, says: tuple[str, ...]) -> None:
    program = boat(tmp_path, change)
    with pytest.raises(ProgramError) as caught:
        probe(program)
    assert caught.value.site == site
    assert "\n" not in str(caught.value)
    for part in (*says, *([site] if site else [])):
        assert part in str(caught.value), part


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        (START, START.removesuffix(".to_event(1)"), "start"),
        (NOISE, "dist.Normal(control, self.noise)", "push"),
        (SEEN, SEEN.removesuffix(".to_event(1)"), "seen"),
    ],
    ids=["initial", "transition", "observe"],
)
def test_a_missing_to_event_is_what_the_message_suspects(tmp_path: Path, old: str, new: str, where: str) -> None:
    program = boat(tmp_path, (old, new))
    with pytest.raises(ProgramError, match=r"to_event\(1\)") as caught:
        probe(program)
    assert where in str(caught.value)


def test_a_missing_to_event_is_found_whatever_the_number_of_components(tmp_path: Path) -> None:
    """The shapes of the probe must not happen to fit: 3, 4 or 5 components are usual."""
    for size in range(1, 8):
        program = boat(
            tmp_path,
            (START, f"dist.Normal(torch.zeros({size}), torch.ones({size}))"),
            ('"x [m]", "v [m/s]")\n    controls', ", ".join(f'"x{i}"' for i in range(size)) + ",)\n    controls"),
            ("x, v = state.unbind(-1)", ""),
            (MOVE, "state + (a * step).unsqueeze(-1)"),
            (SEEN, "dist.Normal(state[..., [0, 0]], 0.1).to_event(1)"),
        )
        with pytest.raises(ProgramError):
            probe(program)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (NOISE, "dist.Normal(control[..., 0].sum(), self.noise)"),
        (MOVE, "state + (state - state.mean(0)) * step.unsqueeze(-1)"),
        (SEEN, "dist.Normal(state.mean(0), 0.1).to_event(1)"),
    ],
    ids=["controls summed", "next state centred", "measurement averaged"],
)
def test_drives_and_draws_must_not_be_mixed(tmp_path: Path, old: str, new: str) -> None:
    program = boat(tmp_path, (old, new))
    with pytest.raises(ProgramError, match="transition|observe"):
        probe(program)


@pytest.mark.parametrize(
    "changes",
    [
        [('"push", dist', '"start", dist')],
        [('"push", dist', '"seen", dist')],
        [('"push", dist', '"states", dist')],
        [(OBSERVE, "\n".join(f'{" " * 8 * i}pyro.sample("seen", dist.Normal(state[..., {i}], 0.1))' for i in (0, 1)))],
    ],
    ids=["noise like start", "noise like measurement", "the engine's own name", "two measurements"],
)
def test_two_sites_of_one_name_are_refused(tmp_path: Path, changes) -> None:
    program = boat(tmp_path, *changes)
    with pytest.raises(ProgramError, match="start|seen|states"):
        probe(program)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('("push [N]",)', '("push [N]")', "controls"),
        ('("x [m]", "v [m/s]")\n    controls', '("x [m]", "x [m]")\n    controls', "states"),
        ("    channels", '    angles = ("z",)\n    channels', "angles"),
        ("    channels", "    step = 0.0\n    channels", "step"),
    ],
    ids=["a lone string", "a name twice", "an unknown angle", "no time step"],
)
def test_declarations_that_make_no_sense_are_refused(tmp_path: Path, old: str, new: str, says: str) -> None:
    program = boat(tmp_path, (old, new))
    with pytest.raises(ProgramError, match=says):
        probe(program)


def test_measurements_of_its_own_are_refused(tmp_path: Path) -> None:
    """With `obs=` a program can be filtered but not simulated."""
    program = boat(tmp_path, (OBSERVE, f"{OBSERVE[:-1]}, obs=state)"))
    with pytest.raises(ProgramError, match="obs="):
        probe(program)


@pytest.mark.parametrize(
    "change",
    [
        (SEEN, "dist.MultivariateNormal(state, 0.01 * torch.eye(2))"),
        (
            OBSERVE,
            'pyro.sample("x", dist.Normal(state[..., 0], 0.1)); pyro.sample("v", dist.Normal(state[..., 1], 0.1))',
        ),
        ('("push [N]",)', "()"),
    ],
    ids=["correlated measurement", "two sites", "no control"],
)
def test_what_is_fine_is_let_through_and_runs(tmp_path: Path, change) -> None:
    changes = [change] if change[1] != "()" else [change, ("control[..., 0]", "0 * v")]
    program = boat(tmp_path, *changes)
    probe(program)
    program.duration = 0.4
    data = for_program(program, simulate(program, 2))
    assert torch.isfinite(log_likelihood(program, data, particles=50, known_start=False, every=1)).all()


def test_the_probe_leaves_the_random_numbers_alone(tmp_path: Path) -> None:
    program = boat(tmp_path)
    torch.manual_seed(3)
    expected = torch.rand(3)
    torch.manual_seed(3)
    probe(program)
    assert torch.equal(torch.rand(3), expected)


def test_correlated_measurements_cannot_be_masked_one_by_one(tmp_path: Path) -> None:
    """Rows that are measured as a whole or not at all pass; a row with one cell missing is an error that says so."""
    program = boat(tmp_path, (SEEN, "dist.MultivariateNormal(state, 0.01 * torch.eye(2))"))
    program.duration = 0.4
    data = for_program(program, simulate(program, 2))
    observed = data.observed.clone()
    observed[2, 0] = False
    whole = replace(data, observed=observed)
    assert torch.isfinite(log_likelihood(program, whole, particles=50, known_start=False, every=1)).all()
    observed = observed.clone()
    observed[3, 1, 0] = False
    with pytest.raises(ProgramError, match="site 'seen' has correlated components .*some are missing") as caught:
        log_likelihood(program, replace(data, observed=observed), particles=50, known_start=False, every=1)
    assert caught.value.site == "seen"


def test_correlated_measurements_weigh_whole_rows_as_independent_ones_do(tmp_path: Path) -> None:
    """With a diagonal covariance the two ways to write it give the same log p(y), bit for bit in the draws."""
    independent = boat(tmp_path)
    correlated = boat(tmp_path, (SEEN, "dist.MultivariateNormal(state, 0.01 * torch.eye(2))"))
    independent.duration = 0.4
    data = for_program(independent, simulate(independent, 2))
    observed = data.observed.clone()
    observed[2, 0] = False
    data = replace(data, observed=observed)
    values = []
    for program in (independent, correlated):
        torch.manual_seed(1)
        values.append(log_likelihood(program, data, particles=50, known_start=False, every=1))
    torch.testing.assert_close(*values, rtol=1e-5, atol=1e-5)  # single precision
