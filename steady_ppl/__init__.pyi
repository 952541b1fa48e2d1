from . import effects as effects
from .auto_rollout import AutoRollout as AutoRollout
from .checking import Check as Check, check as check
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
from .discovery import Discovery as Discovery, discover as discover
from .dynamics import Dynamics as Dynamics
from .errors import (
    DataError as DataError,
    FilterError as FilterError,
    ProgramError as ProgramError,
    RunError as RunError,
    SteadyError as SteadyError,
    TrainingError as TrainingError,
    UsageError as UsageError,
)
from .filtering import (
    choose_filter as choose_filter,
    log_likelihood as log_likelihood,
    neglected as neglected,
    run_filter as run_filter,
    smoothed_states as smoothed_states,
)
from .fit import Fit as Fit
from .gaussian.linearize import why_not_linear as why_not_linear
from .gaussian.single_row_map import fixes as fixes
from .guides import PathGuide as PathGuide, SMCGuide as SMCGuide, TruthGuide as TruthGuide
from .inference_network import InferenceNetwork as InferenceNetwork
from .likelihood_fit import fit_by_likelihood as fit_by_likelihood
from .linearized_guides import GaussianGuide as GaussianGuide, LookaheadGuide as LookaheadGuide
from .model.actuation import delayed as delayed, lagged as lagged
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
from .model.joint import Joint as Joint
from .model.loading import load_program as load_program
from .model.planar_vehicle import (
    ExplicitEuler as ExplicitEuler,
    PlanarVehicle as PlanarVehicle,
    UnknownMap as UnknownMap,
    bearings_to as bearings_to,
    dense as dense,
    stack as stack,
)
from .model.program import Program as Program, for_program as for_program
from .model.substeps import with_substeps as with_substeps
from .parameter_draws import ParameterPosterior as ParameterPosterior, parameter_posterior as parameter_posterior
from .proof_pictures import open_loop_picture as open_loop_picture
from .proving import Proof as Proof, prove as prove
from .reporting import Report as Report, report as report
from .smc.filter import particle_filter as particle_filter, roll_out as roll_out
from .smc.genealogy import Filtered as Filtered, Paths as Paths
from .smc.simulate import simulate as simulate
from .smoother_guide import SmootherGuide as SmootherGuide
from .tempering import Constant as Constant, LinearRamp as LinearRamp
from .training import Optimization as Optimization, Trained as Trained, train as train
from .utils.angles import wrap as wrap
from .utils.random import seeded as seeded
from .validation import Validation as Validation
from .variational_guides import VariationalGuide as VariationalGuide
