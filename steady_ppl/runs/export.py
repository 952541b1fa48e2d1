"""Learned dynamics as a plain torch module: for a controller, a simulator, a planner of one's own."""

from contextlib import nullcontext

import torch
from torch import Tensor, nn

from steady_ppl.errors import UsageError
from steady_ppl.gaussian.predict import errors
from steady_ppl.model.handlers import AtMean, broadcast_shapes, running
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import acting, advance

IMPULSE_ROWS, IMPULSE_SIZES = 200, (1e-3, 1.0, -1e3)  # rows and sizes of a command that is sought in what acts later


class Dynamics(nn.Module):
    """What a program says happens next, as a function of tensors; `...` is any shape.

    It is called like any module, moves with `.to(…)`, is differentiable in states, controls and parameters, and its
    `state_dict()` is the program's.

    Attributes:
        state_names, control_names, measurement_names: what the last dimensions hold, in this order.
        step: s between two controls.
        remembers: whether earlier commands still act (a delay, a lag), with the parameters as they are.

    Example:
        >>> import steady_ppl as st  # doctest: +SKIP
        >>> dynamics = st.Fit.load("runs/after").dynamics(step=0.1)  # doctest: +SKIP
        >>> states = dynamics(state, plan)  # (D,), (H, U) to (H, D)  # doctest: +SKIP
    """

    def __init__(self, program: Program, step: float) -> None:
        super().__init__()
        if not step > 0:
            raise UsageError(f"step must be positive, got {step} s")
        self.program, self.step = program, step
        self.state_names, self.control_names = program.state_names, program.control_names
        self.measurement_names = program.measurement_names

    @property
    @torch.no_grad()
    def remembers(self) -> bool:
        if not self.program.acts_on_commands:
            return False
        like = next(self.program.parameters(), torch.zeros(()))
        elapsed = self.step * torch.arange(IMPULSE_ROWS, dtype=like.dtype, device=like.device)[:, None]
        still = like.new_zeros(IMPULSE_ROWS, 1, len(self.control_names))
        for size in IMPULSE_SIZES:
            once = still.clone()
            once[0] = size
            if not torch.equal(acting(self.program, once, elapsed)[1:], acting(self.program, still, elapsed)[1:]):
                return True
        return False

    def forward(
        self,
        state: Tensor,
        controls: Tensor,
        *,
        past: Tensor | None = None,
        time: float | None = None,
        noisy: bool = False,
    ) -> Tensor:
        """The states that controls lead to.

        Args:
            state: `(..., D)`, where the first control begins to act.
            controls: `(H, ..., U)`, each for one step; without the middle dimensions the same for all states.
            past: `(P, ..., U)` the commands before these, latest last, for programs that remember them; without the
                middle dimensions the same for all plans.
            time: s since the start of the trajectory at the first control; `P` steps when not given.
            noisy: draw the channel noise instead of taking its mean.

        Returns:
            `(H, ..., D)` the state after each control.

        Raises:
            UsageError: another number of states or controls, shapes that do not go together, or the program remembers
                and `past` is not given.
        """
        _require(state, "(..., {})", self.state_names)
        _require(controls, "(rows, ..., {})", self.control_names)
        if past is None and self.remembers:
            how = "give those before as `past`, an empty tensor (0, ..., U) at the start of a trajectory"
            raise UsageError(f"in {type(self.program).__name__} commands act on after their step: {how}")
        past = controls[:0] if past is None else past
        _require(past, "(rows, ..., {})", self.control_names)
        try:
            shape = broadcast_shapes(state.shape[:-1], controls.shape[1:-1], past.shape[1:-1])
        except RuntimeError:
            told = ", ".join(str(tuple(values.shape)) for values in (state, controls, past))
            raise UsageError(f"state, controls and past of shapes {told} do not go together") from None
        commands = torch.cat([_for_all(values, shape) for values in (past, controls)])
        begun = len(past) * self.step if time is None else time
        rows = torch.arange(len(commands), dtype=controls.dtype, device=controls.device) - len(past)
        elapsed = (begun + self.step * rows)[:, None].expand(-1, shape.numel())
        act = acting(self.program, commands.reshape(len(commands), -1, commands.shape[-1]), elapsed)[len(past) :]
        steps = torch.full_like(elapsed[len(past) :], self.step)
        state, states = state.expand(*shape, -1).reshape(-1, state.shape[-1]), []
        for given in zip(act, elapsed[len(past) :], steps, strict=True):
            with running(len(state)), nullcontext() if noisy else AtMean():
                state = advance(self.program, state, *given)
            states.append(state)
        return torch.stack([*states, state])[:-1].reshape(len(controls), *shape, state.shape[-1])

    def measure(self, state: Tensor) -> Tensor:
        """What is measured on average in a state, `(..., K)` of `(..., D)`; angles between −π and π."""
        nothing = state.new_zeros(*state.shape[:-1], len(self.measurement_names))
        return -errors(self.program, state, nothing, torch.ones_like(nothing, dtype=torch.bool))


def _require(values: Tensor, wanted: str, components: tuple[str, ...]) -> None:
    dimensions = wanted.count(",") + 1 - wanted.count("...")
    if values.dim() < dimensions or values.shape[-1] != len(components):
        expected = f"{wanted.format(len(components))} for {', '.join(components)}"
        raise UsageError(f"got a tensor of shape {tuple(values.shape)}, expected {expected}")


def _for_all(values: Tensor, shape: torch.Size) -> Tensor:
    """`(rows, ..., U)` to `(rows, *shape, U)`."""
    missing = (1,) * (len(shape) - values.dim() + 2)
    return values.reshape(len(values), *missing, *values.shape[1:]).expand(len(values), *shape, -1)
