"""Compiled methods are the program: the same numbers from the same noise, whatever its parameters become."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from examples import drives, example
from kernel_programs import EXAMPLES, HovercraftTruth, Stale, Switching, single
from oracles import assert_mean
from scipy import stats

from steady_ppl import Constant, FilterError, SMCGuide, UsageError, bearings_to, particle_filter, seeded, with_substeps
from steady_ppl.gaussian.smoother import find_and_smooth
from steady_ppl.gaussian.twisted_proposal import Twist
from steady_ppl.kernels import jit
from steady_ppl.model.handlers import Recording, draw_starts, running
from steady_ppl.model.problem import Problem
from steady_ppl.smc import compiled, loops
from steady_ppl.smc.compiled import CompiledFilter, compiled_filter, standard_normal
from steady_ppl.smc.proposal import Proposal, Steered
from steady_ppl.smc.resampling import stratified, systematic, take
from steady_ppl.smc.stepping import Stepping


def both(program, data, particles: int = 40, weight: float | torch.Tensor = 0.7):
    """Its kernels and its own lines, and some states."""
    spread = draw_starts(program, 100, 1).std((0, 1))  # a ship turns slower than a hovercraft
    states = 2 * spread * torch.randn(particles, len(data), len(program.states))
    plain = Stepping(program, data, weight)
    machine = compiled_filter(plain, states, Proposal(), systematic)
    assert isinstance(machine, CompiledFilter), machine
    return machine, plain, states


def assert_same(machine: CompiledFilter, plain: Stepping, states: torch.Tensor, row: int = 2) -> None:
    uniform = torch.rand(*states.shape[:2], machine.methods.uniforms)
    moved, values, ratio = machine.transition(row, states, uniform)
    expected, sites = plain.transition(row, states, standard_normal(uniform, machine.methods.channels)[0])
    assert (ratio == 0).all() and machine.methods.event_dims == plain.event_dims
    torch.testing.assert_close(moved, expected, rtol=1e-4, atol=2e-5)
    parts = values.split([machine.methods.sizes[site] for site in sites], -1)
    for value, (site, theirs) in zip(parts, sites.items(), strict=True):
        value = value if plain.event_dims[site] else value[..., 0]
        torch.testing.assert_close(value, theirs.expand_as(value), rtol=1e-4, atol=2e-5)
    density = plain.log_density(row, states)
    torch.testing.assert_close(machine.log_density(row, states)[..., 0], density, rtol=1e-4, atol=2e-3)


@pytest.mark.parametrize("name", EXAMPLES)
def test_kernels_come_to_the_numbers_of_the_programs_own_lines(name):
    program = single(name)
    data = drives(program, 3, 6, gaps=True)
    torch.manual_seed(1)
    assert_same(*both(program, data))


def test_every_trajectory_may_have_an_observation_weight_of_its_own():
    program = single("hovercraft")
    data = drives(program, 3, 6)
    torch.manual_seed(1)
    weights = torch.tensor([0.7, 0.1, 0.0])
    machine, plain, states = both(program, data, weight=weights)
    assert_same(machine, plain, states)
    once = Stepping(program, data, 1.0).log_density(2, states)
    torch.testing.assert_close(plain.log_density(2, states), weights * once)


@pytest.mark.parametrize("error", [0.0, 1.0])
def test_a_trajectory_without_a_density_hides_no_error_of_the_others(error, monkeypatch):
    program = single("hovercraft")
    torch.manual_seed(1)
    machine, _, states = both(program, drives(program, 3, 6))
    impossible = torch.tensor([-math.inf, 0.0, 0.0])
    for owner, away in (
        (CompiledFilter, torch.stack([impossible + error, torch.zeros(3)], -1)),
        (Stepping, impossible),
    ):
        own = owner.log_density
        monkeypatch.setattr(owner, "log_density", lambda self, *given, own=own, away=away: own(self, *given) + away)
    assert machine.agrees(states) == (error == 0)


def test_parameters_that_move_are_read_afresh():
    program = single("hovercraft.py:HovercraftTruth")
    data = drives(program, 2, 5)
    torch.manual_seed(1)
    before, _, states = both(program, data)
    with torch.no_grad():
        for parameter in program.parameters():
            parameter += 0.5
    after, plain, _ = both(program, data)
    assert_same(after, plain, states)
    given = (1, states, torch.rand(*states.shape[:2], 5))
    assert not torch.allclose(before.transition(*given)[0], after.transition(*given)[0])


def test_other_settings_and_other_tensors_are_traced_anew():
    program = single("neural_vehicle.py:NeuralHovercraft")
    data = drives(program, 2, 5)
    torch.manual_seed(1)
    both(program, data)
    program.input_sd = torch.full_like(program.input_sd, 3.0)
    program.hidden_out = torch.nn.Linear(64, 3)
    program.absolute_heading = False
    program.landmarks = ((1.0, 2.0), *program.landmarks[1:])
    assert_same(*both(program, data))


@pytest.mark.slow
@pytest.mark.parametrize("look_ahead", [False, True])
@pytest.mark.parametrize(
    ("name", "substeps", "known_start", "gaps"),
    [
        ("hovercraft.py:HovercraftTruth", 1, True, False),
        ("hovercraft.py:HovercraftTruth", 1, True, True),
        ("hovercraft.py:HovercraftTruth", 3, True, True),
        ("truck", 1, True, True),
        ("pendulum", 2, False, True),
        ("linear_gaussian", 1, False, False),
    ],
)
def test_a_filter_estimates_the_same_with_kernels_as_without(name, substeps, known_start, gaps, look_ahead):
    program = with_substeps(single(name), substeps)
    data = drives(program, 2, 9, gaps=gaps)
    many = data.subset(torch.arange(2).repeat_interleave(100))
    problem, weights = Problem(program, many, known_start), torch.tensor([0.5, 1.0]).repeat(100)
    settings = {"known_start": known_start, "observation_weight": weights, "particles": 128}
    ratios = []
    for kernels in (True, False):
        proposal = Twist(find_and_smooth(problem), untwisted=0.0 if name == "truck" else 0.01) if look_ahead else None
        with seeded("filter", int(kernels)):
            found = particle_filter(program, many, proposal=proposal, kernels=kernels, **settings)
        assert found.in_plain_torch is None
        paths = found.paths(4)
        assert paths.states.shape == (4, 9, 200, len(program.states))
        channels = sum(value[0, 0, 0].numel() for value in paths.noise.values())
        assert channels == len(program.channels)
        ratios.append(found.log_likelihood.view(2, 100))
    level = ratios[1].mean(1, keepdim=True)
    likelihood = [(ratio - level).exp() for ratio in ratios]
    # the difference of independent estimates of p(y) has mean zero
    assert_mean((likelihood[0] - likelihood[1]).t(), 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("look_ahead", [False, True])
@pytest.mark.parametrize("resample_below", [0.0, 0.5, math.inf])
@pytest.mark.parametrize("block_bytes", [compiled.BLOCK_BYTES, 3 * 8000, 2 * 8000, 1])
def test_plain_torch_weighs_the_particles_of_a_compiled_filter_the_same(
    look_ahead, resample_below, block_bytes, monkeypatch
):
    """Evidence, effective sizes, weights, roots and states of every row, from where its particles were."""
    monkeypatch.setattr(compiled, "BLOCK_BYTES", block_bytes)
    program = single("hovercraft.py:HovercraftTruth")
    data = drives(program, 4, 9, gaps=True)
    data = replace(data, observed=data.observed & (torch.arange(9) % 3 < 2)[:, None, None])
    proposal = Twist(find_and_smooth(Problem(program, data, True))) if look_ahead else Proposal()
    settings = {"particles": 50, "known_start": True, "proposal": proposal, "resample_below": resample_below}
    with seeded("compiled"):
        found = particle_filter(program, data, kernels=True, **settings)
    assert found.in_plain_torch is None
    plain = Stepping(program, data, 1.0)
    states, ancestors, noises = found.states, found.ancestors, found.noise["acceleration"]
    log_weights = torch.full((50, 4), -math.log(50.0), dtype=torch.float64)
    roots, evidence = torch.arange(50)[:, None].expand(50, 4), torch.zeros(4, dtype=torch.float64)
    for row in range(9):
        future = torch.zeros(50, 4, dtype=torch.float64)
        measured = bool(data.observed[row].any())
        if measured:
            log_weights = log_weights + plain.log_density(row, states[row])
        if look_ahead:
            given = (values[row] for values in proposal.rows)
            future = torch.where(data.rows[row], proposal.future(states[row], *given), 0.0)
        if measured or look_ahead:
            total = (log_weights + future).logsumexp(0)
            evidence, log_weights = evidence + total, log_weights - total
            sizes = 1 / (log_weights + future).exp().square().sum(0)
            torch.testing.assert_close(found.effective_sizes[row], sizes, rtol=1e-3, atol=1e-3)
        else:
            sizes = torch.full((4,), 50.0, dtype=torch.float64)
            assert (found.effective_sizes[row] == 50).all()
        if row == 8:
            break
        index = ancestors[row]
        assert (index is None) == (not (measured or look_ahead) or not bool((sizes < resample_below * 50).any()))
        at = states[row]
        if index is not None:
            exhausted = sizes < resample_below * 50
            assert torch.equal(index[:, ~exhausted], torch.arange(50)[:, None].expand(50, 4)[:, ~exhausted])
            log_weights = torch.where(exhausted, -math.log(50.0) - take(future, index), log_weights)
            roots, at = take(roots, index), take(at, index)
        noise = noises[row]
        moved = program.integrate(at, noise, data.steps[row])
        torch.testing.assert_close(states[row + 1], moved, rtol=1e-5, atol=1e-5)
        if look_ahead:  # the mixture's density, whichever of its parts a particle was drawn from
            means = channel_means_of(program, at, data, row)
            standard = ((noise - means) / program.noise).double()
            path, _, shift, gain, _, whitening, share = (values[row] for values in proposal.intervals)
            deviation = at.double() - path
            deviation[..., 2] = torch.remainder(deviation[..., 2] + math.pi, 2 * math.pi) - math.pi
            mean = shift - torch.einsum("bcd,nbd->nbc", gain, deviation)
            white = torch.einsum("bij,nbj->nbi", whitening, standard - mean)
            steered = whitening.diagonal(dim1=-2, dim2=-1).log().sum(-1) - 0.5 * white.square().sum(-1)
            own = -0.5 * standard.square().sum(-1)
            ratio = own - torch.logaddexp((1 - share[..., 0]).log() + steered, share[..., 0].log() + own)
            log_weights = log_weights + torch.where(data.rows[row + 1], ratio, 0.0)
    torch.testing.assert_close(found.log_likelihood, evidence, rtol=0, atol=5e-3)
    torch.testing.assert_close(found.log_weights.exp(), log_weights.exp(), rtol=5e-3, atol=1e-6)
    assert torch.equal(found.roots, torch.tensor([float(len(set(own.tolist()))) for own in roots.t()]).double())
    path, _, first = found.history.trace(torch.arange(0, 50, 7)[:, None].expand(-1, 4))
    assert path.shape == (8, 9, 4, 6) and torch.equal(first, roots[::7])


def channel_means_of(program, states, data, row: int) -> torch.Tensor:
    """The accelerations' means, `(N, B, 3)`."""
    with running(*states.shape[:-1]), Recording() as seen:
        program.transition(states, data.controls[row], data.elapsed[row], data.steps[row])
    return seen.distributions["acceleration"].base_dist.loc


@pytest.mark.parametrize("look_ahead", [False, True])
def test_without_history_a_compiled_filter_comes_to_the_same(look_ahead, monkeypatch):
    program = single("hovercraft.py:HovercraftTruth")
    data = drives(program, 2, 9)
    monkeypatch.setattr(compiled, "BLOCK_BYTES", 2 * 5120)
    proposal = Twist(find_and_smooth(Problem(program, data, True))) if look_ahead else None
    found = []
    for keep in (True, False):
        with seeded("history"):
            settings = {"particles": 64, "known_start": True, "proposal": proposal, "kernels": True}
            found.append(particle_filter(program, data, keep_history=keep, **settings))
    assert torch.equal(found[0].log_likelihood, found[1].log_likelihood)
    for name in ("log_weights", "roots", "effective_sizes"):
        assert torch.equal(getattr(found[0], name), getattr(found[1], name))
    with pytest.raises(UsageError, match="keep_history=True"):
        found[1].paths(3)


def test_a_compiled_filter_shows_its_frames():
    """Row by row, as plain torch does: states, and weights before and after the row's measurements."""
    program = single("hovercraft.py:HovercraftTruth")
    data = drives(program, 2, 6)
    frames = []

    def on_frame(row, states, before, after):
        frames.append((row, states.clone(), before.clone(), after.clone()))

    with seeded("frames"):
        found = particle_filter(program, data, particles=64, known_start=True, kernels=True, on_frame=on_frame)
    assert found.in_plain_torch is None and [row for row, *_ in frames] == list(range(6))
    plain = Stepping(program, data, 1.0)
    for (row, states, before, after), kept in zip(frames, found.states, strict=True):
        assert torch.equal(states, kept)
        weighed = before + plain.log_density(row, states)
        torch.testing.assert_close(after, weighed - weighed.logsumexp(0), rtol=1e-4, atol=2e-3)
        torch.testing.assert_close(before.exp().sum(0), torch.ones(2).double())


def test_random_numbers_are_uniform_and_independent_streams():
    """Moments of ten million numbers, of neighbours in a stream and across streams, and of what is made of them."""
    with seeded("uniform"):
        generator = torch.randint(2**32, (4, compiled.STREAMS)).to(torch.uint32).numpy()
    numbers = np.empty((160_000, compiled.STREAMS), np.float32)
    loops.draw(generator, numbers.reshape(-1))
    assert numbers.min() >= 0 and numbers.max() < 1
    counts = np.bincount((numbers.reshape(-1) * 256).astype(int), minlength=256)
    assert stats.chisquare(counts).pvalue > 1e-4
    centred, size = numbers.astype(np.float64) - 0.5, numbers.size
    for neighbour in (np.roll(centred, 1, 0), np.roll(centred, 1, 1), np.roll(centred, 2, 0)):
        assert abs((centred * neighbour).mean()) < 5 / (12 * math.sqrt(size))
    normal, rest = standard_normal(torch.from_numpy(numbers[:, :5].copy()), 3)
    assert stats.kstest(normal.flatten().numpy(), "norm").pvalue > 1e-4
    assert torch.equal(rest[:, 0], torch.from_numpy(numbers[:, 4]))
    assert (torch.corrcoef(normal.T) - torch.eye(3)).abs().max() < 5 / math.sqrt(len(normal))


def test_numbers_at_most_zero_are_exponentiated_to_the_last_digits():
    values = torch.cat([-(10.0 ** torch.linspace(-18, 2.85, 4000, dtype=torch.float64)), torch.zeros(3).double()])
    mine = values.clone()
    loops.exponentiate(mine.numpy(), torch.empty(len(mine), dtype=torch.int64).numpy())
    torch.testing.assert_close(mine, values.exp(), rtol=4e-16, atol=1e-307)
    gone = torch.tensor([-1e4, -math.inf], dtype=torch.float64)
    loops.exponentiate(gone.numpy(), torch.empty(2, dtype=torch.int64).numpy())
    assert (gone == 0).all()


def test_paths_of_a_compiled_filter_are_paths_of_the_program():
    program = single("hovercraft.py:HovercraftTruth")
    data = drives(program, 3, 8)
    guide = SMCGuide(program, particles=1000, draws=5, tempering=Constant(1.0), known_start=True)
    with seeded("paths"):
        guide.refresh(data, 1.0)
    assert guide.in_plain_torch is None and guide.paths is not None
    states, noise = guide.paths.states, guide.paths.noise["acceleration"]
    moved = program.integrate(states[:, :-1], noise, data.steps)
    torch.testing.assert_close(moved, states[:, 1:], rtol=1e-5, atol=1e-5)


def test_a_measurement_that_is_impossible_is_said_to_be_so():
    program = single("linear_gaussian")
    data = drives(program, 2, 6)
    measurements = data.measurements.clone()
    measurements[3, 1] = 1e30
    with pytest.raises(FilterError, match="trajectory 2 at .* impossible"):
        particle_filter(program, replace(data, measurements=measurements), particles=64, kernels=True)


def test_a_program_that_blows_up_is_said_to_have_done_so():
    program = single("hovercraft.py:HovercraftTruth")
    data = drives(program, 2, 6)
    controls = data.controls.clone()
    controls[2, 1] = math.inf
    with pytest.raises(FilterError, match="trajectory 2 at .* that is a number"):
        particle_filter(program, replace(data, controls=controls), particles=64, known_start=True, kernels=True)


class HeavyTailed(HovercraftTruth):
    """Noise that is not normal."""

    def transition(self, state, control, time, step):
        jerk = pyro.sample("acceleration", dist.StudentT(4.0, torch.zeros(3), self.noise).to_event(1))
        return self.integrate(state, jerk.expand(*state.shape[:-1], 3), step)


class ByTrajectory(HovercraftTruth):
    """Has a gain for each of two trajectories, which a kernel, traced for one, cannot know."""

    def __init__(self):
        super().__init__()
        self.register_buffer("gain", torch.tensor([1.0, 1.2]))

    def transition(self, state, control, time, step):
        return super().transition(state, control * self.gain[:, None], time, step)


@pytest.mark.parametrize(
    ("program", "says"),
    [
        (Switching, "reads a number out of a tensor"),
        (HeavyTailed, "StudentT"),
        (ByTrajectory, "mixes particles or trajectories"),
    ],
)
def test_what_cannot_be_compiled_runs_as_written_and_says_why(program, says):
    data = drives(example("hovercraft", torch.float32), 2, 6)
    with seeded("plain"):
        found = particle_filter(program(), data, particles=100, known_start=True, kernels=True)
    assert says in found.in_plain_torch
    with seeded("plain"):
        plain = particle_filter(program(), data, particles=100, known_start=True)
    assert plain.in_plain_torch is None
    assert torch.equal(found.log_likelihood, plain.log_likelihood)


def test_a_kernel_that_has_fallen_behind_its_program_is_found_out():
    program = Stale()
    data = drives(example("hovercraft", torch.float32), 2, 31)
    assert particle_filter(program, data, particles=50, known_start=True, kernels=True).in_plain_torch is None
    with torch.no_grad():
        for parameter in program.parameters():
            parameter += 0.1
    found = particle_filter(program, data, particles=50, known_start=True, kernels=True)
    assert "different numbers" in found.in_plain_torch


class Nearsighted(HovercraftTruth):
    """Measures with a number that a kernel takes for a constant."""

    def observe(self, state):
        scale = float(self.mass.detach().numpy())
        pyro.sample("bearing", bearings_to(self.landmarks, state, sd=0.05 * scale))


def test_a_stale_kernel_is_found_out_where_drives_are_measured_and_end_early():
    program = Nearsighted()
    data = drives(example("hovercraft", torch.float32), 4, 31, gaps=True)
    data = replace(data, observed=data.observed & (torch.arange(31) % 2 == 0)[:, None, None])
    assert not data.observed[-2].any()
    settings = {"particles": 50, "known_start": True, "kernels": True}
    assert particle_filter(program, data, **settings).in_plain_torch is None
    with torch.no_grad():
        program.mass += 0.5
    assert "different numbers" in particle_filter(program, data, **settings).in_plain_torch


class Straight(Steered):
    """Looks ahead at nothing, by functions of its own."""

    channels = 3

    def future(self, state, *given):
        return 0.0 * state[..., 0]


class Blurred(Twist):
    """Thinks otherwise of the future than the twist does."""

    def future(self, state, *given):
        return 0.5 * super().future(state, *given)


def test_proposals_of_several_kinds_have_kernels_of_their_own():
    program = single("hovercraft.py:HovercraftTruth")
    data = drives(program, 2, 9)
    ahead = find_and_smooth(Problem(program, data, True))
    for proposal in (Twist(ahead), Straight(), Blurred(ahead), Twist(ahead), Proposal()):
        found = particle_filter(program, data, particles=64, known_start=True, kernels=True, proposal=proposal)
        assert found.in_plain_torch is None


class Counting(HovercraftTruth):
    """Counts how often it is run."""

    calls = 0

    def transition(self, state, control, time, step):
        self.calls += 1
        return super().transition(state, control, time, step)


def test_a_program_whose_settings_never_rest_is_not_compiled_for_ever():
    program, data = Counting(), drives(example("hovercraft", torch.float32), 2, 4)
    reasons = [particle_filter(program, data, particles=20, kernels=True).in_plain_torch for _ in range(jit.TRACES + 1)]
    assert reasons[0] is None and "change from run to run" in reasons[-1]


class Drawn(Proposal):
    """The program's own noise, by lines of its own."""

    def step(self, row, state):
        return torch.randn(*state.shape[:2], 3), 0.0


class Aimless(Twist):
    """Draws its steps by lines of its own."""

    def step(self, row, state):
        return super().step(row, state)


def test_what_machine_code_cannot_take_runs_in_plain_torch_and_says_why():
    program = single("hovercraft")
    data = drives(program, 2, 6)
    settings = {"particles": 50, "known_start": True, "kernels": True}
    assert "resampler" in particle_filter(program, data, resampler=stratified, **settings).in_plain_torch
    aimless = Aimless(find_and_smooth(Problem(program, data, True)))
    for proposal in (aimless, Drawn()):
        assert "no function" in particle_filter(program, data, proposal=proposal, **settings).in_plain_torch


def test_kernels_are_for_single_precision_and_more_than_a_few_particles():
    program = example("hovercraft", torch.float64)
    data = drives(program, 2, 6)
    assert "float64" in particle_filter(program, data, particles=50, kernels=True).in_plain_torch
    program = single("hovercraft")
    data = drives(program, 2, 6)
    assert "fewer than" in particle_filter(program, data, particles=5, kernels=True).in_plain_torch
