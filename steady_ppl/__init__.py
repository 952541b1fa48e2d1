"""Learn how a vehicle moves from noisy, indirect measurements, with its state-space model written as a Pyro program.

Names are imported when they are first used, so that the command line answers `--help` without loading torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from steady_ppl.actuation import delayed, lagged
    from steady_ppl.altering import Coloured, blurred, channel_means, heavy_tailed, misread, pushed, widened
    from steady_ppl.arrays import from_arrays
    from steady_ppl.auto_rollout import AutoRollout
    from steady_ppl.bag_mapping import BagColumn, BagMapping
    from steady_ppl.bags import read_bags
    from steady_ppl.checking import Check, check
    from steady_ppl.data import Trajectories
    from steady_ppl.discovery import Discovery, discover
    from steady_ppl.dynamics import Dynamics
    from steady_ppl.errors import (
        DataError,
        FilterError,
        ProgramError,
        RunError,
        SteadyError,
        TrainingError,
        UsageError,
    )
    from steady_ppl.filtering import choose_filter, log_likelihood, neglected, run_filter, smoothed_states
    from steady_ppl.fit import Fit
    from steady_ppl.fixes import fixes
    from steady_ppl.guides import PathGuide, SMCGuide, TruthGuide
    from steady_ppl.inference_network import InferenceNetwork
    from steady_ppl.joint import Joint
    from steady_ppl.likelihood_fit import fit_by_likelihood
    from steady_ppl.linearization import why_not_linear
    from steady_ppl.linearized_guides import GaussianGuide, LookaheadGuide
    from steady_ppl.long_drives import cut
    from steady_ppl.parameter_draws import ParameterPosterior, parameter_posterior
    from steady_ppl.particles import particle_filter, roll_out
    from steady_ppl.paths import Filtered, Paths
    from steady_ppl.planar_vehicle import (
        ExplicitEuler,
        PlanarVehicle,
        UnknownMap,
        WrappedNormal,
        bearings_to,
        dense,
        stack,
        wrap,
    )
    from steady_ppl.program import Program, for_program
    from steady_ppl.program_file import load_program
    from steady_ppl.proof_pictures import open_loop_picture
    from steady_ppl.proving import Proof, prove
    from steady_ppl.reporting import Report, report
    from steady_ppl.seeding import seeded
    from steady_ppl.simulation import simulate
    from steady_ppl.smoother_guide import SmootherGuide
    from steady_ppl.substeps import with_substeps
    from steady_ppl.table import from_frame, read_table, to_frame, write_table
    from steady_ppl.tempering import Constant, LinearRamp
    from steady_ppl.training import Optimization, Trained, train
    from steady_ppl.validation import Validation
    from steady_ppl.variational_guides import VariationalGuide

_HOMES = {
    "actuation": ("delayed", "lagged"),
    "altering": ("Coloured", "blurred", "channel_means", "heavy_tailed", "misread", "pushed", "widened"),
    "arrays": ("from_arrays",),
    "auto_rollout": ("AutoRollout",),
    "bag_mapping": ("BagColumn", "BagMapping"),
    "bags": ("read_bags",),
    "checking": ("Check", "check"),
    "data": ("Trajectories",),
    "discovery": ("Discovery", "discover"),
    "dynamics": ("Dynamics",),
    "errors": ("DataError", "FilterError", "ProgramError", "RunError", "SteadyError", "TrainingError", "UsageError"),
    "filtering": ("choose_filter", "log_likelihood", "neglected", "run_filter", "smoothed_states"),
    "fit": ("Fit",),
    "fixes": ("fixes",),
    "guides": ("PathGuide", "SMCGuide", "TruthGuide"),
    "inference_network": ("InferenceNetwork",),
    "joint": ("Joint",),
    "likelihood_fit": ("fit_by_likelihood",),
    "linearization": ("why_not_linear",),
    "linearized_guides": ("GaussianGuide", "LookaheadGuide"),
    "long_drives": ("cut",),
    "parameter_draws": ("ParameterPosterior", "parameter_posterior"),
    "particles": ("particle_filter", "roll_out"),
    "paths": ("Filtered", "Paths"),
    "planar_vehicle": (
        "ExplicitEuler",
        "PlanarVehicle",
        "UnknownMap",
        "WrappedNormal",
        "bearings_to",
        "dense",
        "stack",
        "wrap",
    ),
    "program": ("Program", "for_program"),
    "program_file": ("load_program",),
    "proof_pictures": ("open_loop_picture",),
    "proving": ("Proof", "prove"),
    "reporting": ("Report", "report"),
    "seeding": ("seeded",),
    "simulation": ("simulate",),
    "smoother_guide": ("SmootherGuide",),
    "substeps": ("with_substeps",),
    "tempering": ("Constant", "LinearRamp"),
    "table": ("from_frame", "read_table", "to_frame", "write_table"),
    "training": ("Optimization", "Trained", "train"),
    "validation": ("Validation",),
    "variational_guides": ("VariationalGuide",),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}
__all__ = sorted(_HOME)  # pyright: ignore


def __getattr__(name: str) -> Any:
    if name == "effects":
        return import_module("steady_ppl.effects")
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"steady_ppl.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
