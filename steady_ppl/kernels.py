"""Kernels: machine code that runs for all particles of all trajectories."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import binding

from steady_ppl.kernel_writer import LANES, NAME


class Kernel:
    """A compiled function.

    Args:
        text: its `source`.
        inputs, outputs: how many arrays it takes, and how many numbers a particle it gives.
    """

    def __init__(self, text: str, inputs: int, outputs: int) -> None:
        self.outputs = outputs
        self._engine = _machine_code(text)
        arguments = [ctypes.c_void_p] * (inputs + 4) + [ctypes.c_int64] * 3
        self._call = ctypes.CFUNCTYPE(None, *arguments)(self._engine.get_function_address(NAME))

    def __call__(
        self,
        parameters: np.ndarray,
        uniform: np.ndarray,
        inputs: Sequence[np.ndarray],
        ancestors: np.ndarray | None,
        out: np.ndarray,
    ) -> None:
        """Compute `out`.

        Args:
            parameters: `(P,)` what the graph takes of them.
            uniform: `(B, columns)`.
            inputs: each `(elements, B, N)`, N at least `LANES`.
            ancestors: `(B, N)` int64, where the first input is looked up; None: at each particle itself.
            out: `(outputs, B, N)`, overwritten; shares no memory with the inputs.
        """
        _, trajectories, particles = out.shape
        for array in (parameters, uniform, *inputs, out):
            assert array.dtype == np.float32 and array.flags.c_contiguous
        assert len(out) == self.outputs and len(uniform) == trajectories
        assert particles >= LANES and all(array.shape[1:] == out.shape[1:] for array in inputs)
        assert ancestors is None or (ancestors.dtype == np.int64 and ancestors.flags.c_contiguous)
        pointers = [parameters.ctypes.data, uniform.ctypes.data, *(array.ctypes.data for array in inputs)]
        which = None if ancestors is None else ancestors.ctypes.data
        self._call(*pointers, which, out.ctypes.data, trajectories, particles, uniform.shape[1])


def _machine_code(text: str) -> Any:
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    module = binding.parse_assembly(text)
    target = binding.Target.from_default_triple()
    machine = target.create_target_machine(
        cpu=binding.get_host_cpu_name(), features=binding.get_host_cpu_features().flatten(), opt=3
    )
    options = binding.create_pipeline_tuning_options(speed_level=2)
    builder = binding.create_pass_builder(machine, options)
    builder.getModulePassManager().run(module, builder)
    engine = binding.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    return engine
