"""Kernels compute what torch computes: every operation, and graphs with every kind of vector."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from steady_ppl.kernels.codegen import SIMD_LANES, source
from steady_ppl.kernels.graph import PARTICLE, NotCompilable, ScalarGraph
from steady_ppl.kernels.jit import Kernel, Method

SPECIAL = [
    0.0,
    -0.0,
    1.0,
    -1.0,
    math.inf,
    -math.inf,
    math.nan,
    1e-30,
    -1e-30,
    80.0,
    -80.0,
    1e30,
    700.0,
    -700.0,
    0.5,
    3.0,
]


def kernel_of(
    function: Callable[..., Tensor], *inputs: Tensor, uniform: Tensor | None = None, differentiate: bool = False
) -> Tensor:
    """The function of `(B, N)` inputs, and of numbers that differ between trajectories only, `(B,)`, by a kernel; with
    `differentiate` its derivatives in the inputs instead."""
    names = [f"x{i}" for i in range(len(inputs))]
    particle = {name: one[:1, 0].clone() for name, one in zip(names, inputs, strict=True)}
    shared = {} if uniform is None else {"u": uniform[:1].clone()}
    along = names if differentiate else ()
    method = Method(nn.Module(), lambda *values: (function(*values),), particle, shared, along=along)
    out = torch.empty(len(method.graph.outputs), *inputs[0].shape)
    columns = (torch.zeros(len(inputs[0]), 1) if uniform is None else uniform[:, None]).numpy()
    given = [one.unsqueeze(0).contiguous().numpy() for one in inputs]
    method.kernel(method.parameters(nn.Module()), columns, given, None, out.numpy())
    return out[method.values :] if differentiate else out


def relative(mine: Tensor, exact: Tensor) -> float:
    """The largest error in units of single precision."""
    return float(((mine.double() - exact) / exact.abs().clamp(min=1e-30)).abs().max() / 2**-24)


@pytest.mark.parametrize(
    ("function", "low", "high", "units"),
    [
        (torch.exp, -87.0, 88.0, 3),
        (torch.log, 1e-30, 1e30, 3),
        (torch.log1p, -0.99, 1e6, 6),
        (torch.expm1, -80.0, 80.0, 8),
        (torch.tanh, -20.0, 20.0, 6),
        (torch.sigmoid, -80.0, 80.0, 8),
        (torch.atan, -1e4, 1e4, 4),
        (torch.sqrt, 0.0, 1e10, 2),
        (torch.rsqrt, 1e-10, 1e10, 4),
        (nn.functional.softplus, -80.0, 80.0, 8),
    ],
)
def test_a_function_is_exact_to_a_few_units_in_the_last_place(function, low, high, units):
    grid = torch.linspace(low, high, 20_000).unsqueeze(0)
    if low > 0:
        grid = torch.linspace(math.log(low), math.log(high), 20_000).exp().unsqueeze(0)
    assert relative(kernel_of(function, grid)[0], function(grid.double())) < units


@pytest.mark.parametrize("function", [torch.sin, torch.cos])
def test_sine_and_cosine_are_exact_for_headings_of_many_turns(function):
    grid = torch.linspace(-2000.0, 2000.0, 50_001).unsqueeze(0)
    assert float((kernel_of(function, grid)[0].double() - function(grid.double())).abs().max()) < 4 * 2**-24


def test_the_direction_is_exact_in_every_quadrant():
    angle = torch.linspace(-math.pi, math.pi, 4097, dtype=torch.float64)[None]
    x, y = (3.7 * angle.cos()).float(), (3.7 * angle.sin()).float()
    exact = torch.atan2(y.double(), x.double())
    assert float((kernel_of(torch.atan2, y, x)[0].double() - exact).abs().max()) < 4 * 2**-23


@pytest.mark.parametrize(
    "function",
    [
        *(torch.exp, torch.log, torch.tanh, torch.sigmoid, torch.relu, torch.abs, torch.floor, torch.round, torch.sign),
        *(torch.sqrt, torch.log1p, nn.functional.softplus, torch.square, torch.neg, torch.ceil, torch.asin, torch.acos),
        lambda x: ((x > 0) == (x < 2)).float(),
        lambda x: x.clamp(-1.0, 2.0),
        lambda x: torch.where(x > 0.5, x, -x),
        lambda x: torch.maximum(x, -x) + torch.minimum(x, torch.zeros_like(x)),
        lambda x: ((x > 0) & (x < 2) | ~(x < 60)).float(),
        lambda x: (x == x).float() + (x != x).float() * 2,
    ],
)
def test_what_is_special_to_torch_is_special_to_a_kernel(function):
    x = torch.tensor([SPECIAL])
    torch.testing.assert_close(kernel_of(function, x)[0], function(x), equal_nan=True, rtol=1e-6, atol=1e-35)


ARITHMETIC = [
    lambda x, y: x + 2 * y - x * y / (1 + y * y),
    lambda x, y: torch.hypot(x, y) + x**2 + x**3 + (1 + y * y) ** 0.5 + (1 + y * y) ** -0.5,
    lambda x, y: (x.abs() + 0.1) ** 1.7 + (x.abs() + 0.1) ** (y * 0.1),
    lambda x, y: torch.remainder(x, 0.7) + 3 - torch.sub(x, y, alpha=2) - 1.0 / (2 + x * x),
    lambda x, y: (0.3 * x) ** 5 + (2 + x * x) ** -3 + (0.2 * x - 0.5) ** 7 + 1.5**y,
    lambda x, y: nn.functional.silu(x) + nn.functional.leaky_relu(y, 0.2) + (0.3 * x).clamp(-0.9, 0.9).asin(),
    lambda x, y: torch.stack([x, y], -1).norm(dim=-1) + torch.stack([x, y], -1).sum(-1) * torch.cat([x, y]).mean(),
    lambda x, y: torch.linalg.solve(torch.tensor([[2.0, 0.3], [0.1, 1.0]]), torch.eye(2))[0, 1] * x + y,
    lambda x, y: torch.sin(x) * torch.cos(y) + torch.tan(0.3 * x) + torch.atan2(x, y) + torch.atan(x),
    lambda x, y: torch.exp(-x) + torch.log(1 + x * x) + torch.log1p(y * y) + torch.expm1(0.2 * y) + torch.tanh(x * y),
    lambda x, y: torch.sqrt(1 + x * x) + torch.rsqrt(2 + y * y) + torch.reciprocal(3 + x * x) + x.square() + x.abs(),
    lambda x, y: nn.functional.softplus(x) + torch.sigmoid(y) + (0.2 * x).clamp(-0.9, 0.9).acos() - y.relu(),
    lambda x, y: torch.where(x > y, x * x, 3 * y),
    lambda x, y: torch.maximum(x, y * y) + torch.minimum(x, y) + (x > 0).float() * y + torch.floor(x) * y + x.sign(),
]


@pytest.mark.parametrize("function", ARITHMETIC)
def test_arithmetic_is_that_of_torch(function):
    torch.manual_seed(0)
    x, y = 2 * torch.randn(1, 1, 200), 2 * torch.randn(1, 1, 200)
    each = torch.stack([function(a, b) for a, b in zip(x[0, 0, :, None], y[0, 0, :, None], strict=True)], -1)
    torch.testing.assert_close(kernel_of(function, x[0], y[0])[0], each.expand(1, -1), rtol=3e-6, atol=3e-6)


@pytest.mark.slow
@pytest.mark.parametrize("function", ARITHMETIC)
def test_derivatives_are_those_of_torch(function):
    torch.manual_seed(0)
    x, y = 2 * torch.randn(1, 1, 200), 2 * torch.randn(1, 1, 200)
    pairs = list(zip(x[0, 0, :, None], y[0, 0, :, None], strict=True))
    exact = [torch.autograd.functional.jacobian(lambda a, b: function(a, b).sum(), pair) for pair in pairs]
    expected = torch.stack([torch.cat(one) for one in exact], 1)
    found = kernel_of(lambda a, b: function(a, b).sum(-1), x[0], y[0], differentiate=True)[:, 0]
    torch.testing.assert_close(found, expected, rtol=2e-5, atol=2e-5)


@pytest.mark.parametrize("function", [torch.atan2, torch.hypot, torch.maximum, torch.minimum, torch.remainder])
def test_what_is_not_a_number_stays_so(function):
    x, nan = torch.ones(1, 20), torch.full((1, 20), math.nan)
    assert kernel_of(function, x, nan).isnan().all() and kernel_of(function, nan, x).isnan().all()


def test_a_value_at_its_bound_passes_its_derivative_on():
    x = torch.zeros(1, 20)
    bounded = (lambda x: x.clamp(min=0.0), lambda x: x.clamp(max=0.0), lambda x: x.clamp_max(0.0))
    for function in (*bounded, lambda x: x.to(torch.float32, copy=True)):
        assert (kernel_of(function, x, differentiate=True) == 1).all()


def test_a_remainder_lies_between_zero_and_its_divisor():
    x = 0.1 * torch.arange(-1600.0, 1600.0)[None]
    rest = kernel_of(lambda x: x % 0.1, x)[0]
    assert ((rest >= 0) & (rest < 0.1)).all()


def network(hidden: int, layers: int, outputs: int = 3) -> nn.Module:
    torch.manual_seed(1)
    inner = [module for _ in range(layers - 1) for module in (nn.Linear(hidden, hidden), nn.Tanh())]
    return nn.Sequential(nn.Linear(3, hidden), nn.ReLU(), *inner, nn.Linear(hidden, outputs))


@pytest.mark.parametrize(("hidden", "layers"), [(5, 1), (64, 1), (33, 1), (64, 2), (20, 3)])
@pytest.mark.parametrize("columns", [False, True])
def test_a_network_of_any_size_is_that_of_torch(hidden, layers, columns):
    layers_of = network(hidden, layers)

    def function(x: Tensor, y: Tensor, u: Tensor) -> Tensor:
        inputs = torch.stack([x, y, u], -1)
        if not columns:
            return layers_of(inputs) * x
        for module in layers_of:  # as matrices times columns
            linear = isinstance(module, nn.Linear)
            inputs = (module.weight @ inputs.mT + module.bias[:, None]).mT if linear else module(inputs)
        return inputs * x

    x, y, u = torch.randn(2, 40), torch.randn(2, 40), torch.randn(2)
    with torch.no_grad():
        mine = kernel_of(function, x, y, uniform=u)
        theirs = layers_of(torch.stack([x, y, u[:, None].expand_as(x)], -1)) * x[..., None]
    torch.testing.assert_close(mine.permute(1, 2, 0), theirs, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("hidden", "layers"), [(5, 1), (64, 1), (64, 2)])
def test_a_networks_derivatives_are_those_of_torch(hidden, layers):
    layers_of = network(hidden, layers)

    def function(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        return layers_of(torch.stack([x * y, y, z], -1)) * x.unsqueeze(-1)

    inputs = torch.randn(3, 40)
    found = kernel_of(function, *inputs.unsqueeze(1), differentiate=True).view(3, 3, 40)
    exact = torch.vmap(torch.func.jacfwd(lambda v: function(*v)))(inputs.t())
    torch.testing.assert_close(found.permute(2, 0, 1), exact.detach(), rtol=1e-4, atol=1e-5)


def test_residual_layers_and_two_heads_of_one_hidden_layer_are_those_of_torch():
    first, second, heads = nn.Linear(2, 32), nn.Linear(32, 32), (nn.Linear(32, 3), nn.Linear(32, 2))

    def function(x: Tensor, y: Tensor) -> Tensor:
        hidden = first(torch.stack([x, y], -1)).relu()
        hidden = hidden + torch.sigmoid(second(hidden)) * x.unsqueeze(-1)
        return torch.cat([head(hidden) for head in heads], -1) + hidden[..., 7:12]

    x, y = torch.randn(1, 50), torch.randn(1, 50)
    with torch.no_grad():
        mine, theirs = kernel_of(function, x, y), function(x[0], y[0])
    torch.testing.assert_close(mine[:, 0].t(), theirs, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("particles", [SIMD_LANES, SIMD_LANES + 1, 3 * SIMD_LANES - 1, 5 * SIMD_LANES])
def test_any_number_of_particles_is_worked_through(particles):
    x, u = torch.arange(3.0 * particles).view(3, particles), torch.tensor([1.0, 2.0, 3.0])
    assert torch.equal(kernel_of(lambda x, u: 2 * x + u, x, uniform=u)[0], 2 * x + u[:, None])


def test_assignments_in_place_are_understood():
    def function(x: Tensor, y: Tensor) -> Tensor:
        both = torch.stack([x, y], -1).clone()
        both[..., 0] += 3 * y
        both[..., 1] = both[..., 0] * 2
        both *= 2
        return both[..., [1, 0]]

    x, y = torch.randn(1, 20), torch.randn(1, 20)
    expected = function(x[0], y[0])
    torch.testing.assert_close(kernel_of(function, x, y)[:, 0].t(), expected)


@pytest.mark.parametrize(
    ("function", "says"),
    [
        (torch.erfc, "no kernel for aten.erfc"),
        (lambda x: x + torch.randn(()), "random numbers of its own"),
        (lambda x: x.double().exp().float(), "it computes in float64"),
        (lambda x: x > 0, "a truth value as a result"),
        (lambda x: (x > -9) + (x > -8), "arithmetic with truth values"),
        (lambda x: x**21, "a power of 21"),
        (lambda x: x[:0] * 2, "it cannot be compiled"),
        (lambda x: torch.tensor([1.0, 2.0])[(x > 0).long()], "it computes in int64"),
        (lambda x: torch.linspace(0, 1, 13_000) * x, "more than"),
    ],
)
def test_what_has_no_kernel_is_refused(function, says):
    with pytest.raises(NotCompilable, match=says):
        kernel_of(function, torch.randn(1, 20))


def test_a_kernel_looks_its_first_input_up_at_the_ancestors():
    graph = ScalarGraph({"state": PARTICLE, "noise": PARTICLE})
    graph.outputs = [graph.scalar("add", graph.scalar("input", "state", 1), graph.scalar("input", "noise", 0))]
    kernel = Kernel("a sum", lambda: source(graph, ["state", "noise"], {}), 2, 1)
    torch.manual_seed(0)
    state, noise = torch.randn(2, 3, 40), torch.randn(1, 3, 40)
    ancestors = torch.randint(40, (3, 40))
    out = torch.empty(1, 3, 40)
    nothing = np.zeros((1,), np.float32), np.zeros((3, 1), np.float32)
    kernel(*nothing, [state.numpy(), noise.numpy()], ancestors.numpy(), out.numpy())
    assert torch.equal(out[0], state[1].gather(1, ancestors) + noise[0])
