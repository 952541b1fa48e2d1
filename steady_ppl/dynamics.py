"""Learned dynamics as a plain torch module: for a controller, a simulator, a planner of one's own."""

from __future__ import annotations

from contextlib import nullcontext

import torch
from torch import Tensor, nn

from steady_ppl.errors import UsageError
from steady_ppl.predictions import errors
from steady_ppl.program import Program, names
from steady_ppl.sites import AtMean, running


class Dynamics(nn.Module):
    """What a program says happens next, as a function of tensors.

    Nothing of Pyro is seen from outside: it is called like any module, moves with `.to(…)`, is differentiable in
    states, controls and parameters, and its `state_dict()` is the program's. `...` is any shape.

    Attributes:
        state_names, control_names, measurement_names: what the last dimensions hold, in this order.
        step: s between two controls.
        remembers: whether earlier commands still act (a delay, a lag).

    Example:
        >>> import steady_ppl as st  # doctest: +SKIP
        >>> dynamics = st.Fit.load("runs/after").dynamics(step=0.1)  # doctest: +SKIP
        >>> states = dynamics(state, plan)  # (D,), (H, U) to (H, D)  # doctest: +SKIP
    """

    def __init__(self, program: Program, step: float) -> None:
        super().__init__()
        if not step > 0:
            raise UsageError(f"a step of {step} s leads nowhere")
        self.program = program
        self.step = step
        self.state_names, self.control_names = names(program.states), names(program.controls)
        self.measurement_names = names(program.measurements)
        self.remembers = type(program).actuators is not Program.actuators

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
            controls: `(H, ..., U)`, each for one step.
            past: `(P, ..., U)` the commands before these, latest last; for programs that remember them.
            time: s since the start of the drive at the first control; `P` steps when not given.
            noisy: draw the channel noise instead of taking its mean.

        Returns:
            `(H, ..., D)` the state after each control.

        Raises:
            UsageError: another number of states or controls, or the program remembers and `past` is not given.
        """
        for values, wanted in ((state, self.state_names), (controls, self.control_names)):
            if values.shape[-1:] != (len(wanted),):
                expected = f"(..., {len(wanted)}) for {', '.join(wanted)}"
                raise UsageError(f"got a tensor of shape {tuple(values.shape)}, expected {expected}")
        if past is None:
            if self.remembers:
                raise UsageError(
                    f"in {type(self.program).__name__} commands act on after their step: give those before as `past`, "
                    "an empty tensor (0, ..., U) at the start of a drive"
                )
            past = controls[:0]
        shape = torch.broadcast_shapes(state.shape[:-1], controls.shape[1:-1])
        commands = torch.cat([values.expand(len(values), *shape, -1) for values in (past, controls)])
        begun = len(past) * self.step if time is None else time
        rows = torch.arange(len(commands), dtype=controls.dtype, device=controls.device) - len(past)
        elapsed = (begun + self.step * rows)[:, None].expand(-1, shape.numel())
        acting = self.program.actuators(commands.reshape(len(commands), -1, commands.shape[-1]), elapsed)[len(past) :]
        steps = torch.full_like(elapsed[len(past) :], self.step)
        state, states = state.expand(*shape, -1).reshape(-1, state.shape[-1]), []
        for given in zip(acting, elapsed[len(past) :], steps, strict=True):
            with running(len(state)), nullcontext() if noisy else AtMean():
                state = self.program.transition(state, *given)
            states.append(state)
        return torch.stack(states).reshape(len(controls), *shape, -1)

    def measure(self, state: Tensor) -> Tensor:
        """What is measured on average in a state, `(..., K)` of `(..., D)`; angles between −π and π."""
        nothing = state.new_zeros(*state.shape[:-1], len(self.measurement_names))
        return -errors(self.program, state, nothing, torch.ones_like(nothing, dtype=torch.bool))
