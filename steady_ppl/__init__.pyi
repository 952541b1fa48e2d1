from . import effects as effects
from .comparison.prove import prove as prove
from .comparison.result import Proof as Proof
from .criticism.check import check as check
from .criticism.result import Check as Check
from .data.logs.mapping import LogColumn as LogColumn, LogMapping as LogMapping
from .data.logs.read import read_logs as read_logs
from .data.rosbag.mapping import BagColumn as BagColumn, BagMapping as BagMapping
from .data.rosbag.read import read_bags as read_bags
from .data.table import (
    cut as cut,
    from_arrays as from_arrays,
    from_frame as from_frame,
    read_table as read_table,
    to_frame as to_frame,
    write_table as write_table,
)
from .data.trajectories import Trajectories as Trajectories
from .discovery.discover import discover as discover
from .discovery.result import Discovery as Discovery
from .errors import (
    DataError as DataError,
    FilterError as FilterError,
    ProgramError as ProgramError,
    RunError as RunError,
    SteadyError as SteadyError,
    TableWarning as TableWarning,
    TrainingError as TrainingError,
    UsageError as UsageError,
)
from .gaussian.linearize import why_not_linear as why_not_linear
from .gaussian.single_row_map import fixes as fixes
from .guides.linearized import (
    GaussianGuide as GaussianGuide,
    LookaheadGuide as LookaheadGuide,
    SmootherGuide as SmootherGuide,
)
from .guides.path_guides import (
    Constant as Constant,
    LinearRamp as LinearRamp,
    PathGuide as PathGuide,
    SMCGuide as SMCGuide,
    TruthGuide as TruthGuide,
)
from .guides.variational import (
    AutoRollout as AutoRollout,
    InferenceNetwork as InferenceNetwork,
    VariationalGuide as VariationalGuide,
)
from .likelihood.evidence import (
    choose_filter as choose_filter,
    log_likelihood as log_likelihood,
    neglected as neglected,
    run_filter as run_filter,
    smoothed_states as smoothed_states,
)
from .likelihood.maximize import fit_by_likelihood as fit_by_likelihood
from .likelihood.parameter_posterior import (
    ParameterPosterior as ParameterPosterior,
    parameter_posterior as parameter_posterior,
)
from .model.actuation import delayed as delayed, lagged as lagged, rate_limited as rate_limited
from .model.distributions import WrappedNormal as WrappedNormal
from .model.interventions import (
    Coloured as Coloured,
    blurred as blurred,
    channel_means as channel_means,
    heavy_tailed as heavy_tailed,
    misread as misread,
    pushed as pushed,
    widened as widened,
)
from .model.loading import load_program as load_program
from .model.planar_vehicle import (
    ExplicitEuler as ExplicitEuler,
    PlanarVehicle as PlanarVehicle,
    UnknownMap as UnknownMap,
    bearings_to as bearings_to,
    dense as dense,
    stack as stack,
)
from .model.problem import Joint as Joint
from .model.program import Program as Program, for_program as for_program
from .model.substeps import with_substeps as with_substeps
from .plotting.comparison import open_loop_picture as open_loop_picture
from .reporting.report import Report as Report, report as report
from .runs.diagnostics import doctor as doctor
from .runs.export import Dynamics as Dynamics
from .runs.fit import Fit as Fit
from .smc.filter import particle_filter as particle_filter
from .smc.genealogy import Filtered as Filtered, Paths as Paths
from .smc.simulate import roll_out as roll_out, simulate as simulate
from .training.loop import Optimization as Optimization, Trained as Trained, Validation as Validation, train as train
from .utils.angles import wrap as wrap
from .utils.random import seeded as seeded
