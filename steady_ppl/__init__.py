"""Learn how a vehicle moves from noisy, indirect measurements, with its state-space model written as a Pyro program."""

from steady_ppl.data import Trajectories
from steady_ppl.errors import (
    DataError,
    FilterError,
    ProgramError,
    RunError,
    SteadyError,
    TrainingError,
    UsageError,
)
from steady_ppl.filtering import log_likelihood, smoothed_states
from steady_ppl.fit import Fit
from steady_ppl.guides import Constant, LinearRamp, PathGuide, SMCGuide, TruthGuide
from steady_ppl.joint import Joint
from steady_ppl.particle_filter import Filtered, Paths, particle_filter, roll_out
from steady_ppl.planar_vehicle import PlanarVehicle, WrappedNormal, bearings_to, stack, wrap
from steady_ppl.program import Program, for_program, load_program
from steady_ppl.seeding import seeded
from steady_ppl.simulation import simulate
from steady_ppl.table import read_table, write_table
from steady_ppl.training import Optimization, Trained, train
from steady_ppl.validation import Validation

__all__ = [
    "Constant",
    "DataError",
    "FilterError",
    "Filtered",
    "Fit",
    "Joint",
    "LinearRamp",
    "Optimization",
    "PathGuide",
    "Paths",
    "PlanarVehicle",
    "Program",
    "ProgramError",
    "RunError",
    "SMCGuide",
    "SteadyError",
    "Trained",
    "TrainingError",
    "Trajectories",
    "TruthGuide",
    "UsageError",
    "Validation",
    "WrappedNormal",
    "bearings_to",
    "for_program",
    "load_program",
    "log_likelihood",
    "particle_filter",
    "read_table",
    "roll_out",
    "seeded",
    "simulate",
    "smoothed_states",
    "stack",
    "train",
    "wrap",
    "write_table",
]
