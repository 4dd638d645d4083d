from .arrowhead.build import compiled_motions
from .arrowhead.covariance import SquareRoot
from .arrowhead.dissection import LARGE
from .arrowhead.elimination import eliminate_columns
from .arrowhead.tree import Tree
from .bias import MEAN_SHARE, SHARE_VARIANCE, bias_of, correct_bias, cost_of_bias, covariance_with_bias
from .budget import Budget, BudgetSpentError, budgets_of
from .damping import Damping
from .factors.odometry_and_observations import (
    CalibrationPrior,
    Columns,
    Linearised,
    ObservationFactors,
    OdometryFactors,
    State,
    stack,
    whitening,
)
from .factors.priors import NO_PRIORS, DistanceFactors, JointPrior, Priors, StartFactors, ends_of
from .graph import Graph, build_graph, columns_of, unheld
from .growing_problem import GrowingProblem
from .linearisation.kernels import OdometryArrays, Values, advance, go_along, multiply, series, wrap
from .linearisation.observations import N_OBSERVATION, observation_factor
from .linearisation.odometry import error_by_wheels, error_of, motion_at, scaled_information, wheel_correction
from .linearisation.robust_losses import Loss, huber, loss_and_weight, losses_and_weights
from .minimisation import COST_TOLERANCE, MAX_TRIES, NOISY_COST_TOLERANCE, factorise
from .multifrontal.fronts import (
    EliminationFronts,
    FrontFactor,
    Normal,
    NotPositiveError,
    build_fronts,
    common_ancestor,
)
from .multifrontal.kernels import FrontalSystem, Kind, Nodes, Unsigned, add_matrix, add_vector, add_vectors
from .parameters import (
    NO_PARAMETER,
    Parameter,
    is_of_segment,
    mount_parameters_of,
    odometry_parameters_of,
    parameter_of_scale,
    parameters_of_camera,
    parameters_of_gyro,
    parameters_of_wheels,
)
from .partition.solver import solve_with_workers
from .solver import (
    DEFAULT_LOSSES,
    HUBER_THRESHOLD,
    MAX_RELATIVE_ERROR,
    PLAIN_SQUARES,
    Losses,
    Problem,
    Solution,
    solve,
)

__all__ = [
    "COST_TOLERANCE",
    "DEFAULT_LOSSES",
    "HUBER_THRESHOLD",
    "LARGE",
    "MAX_RELATIVE_ERROR",
    "MAX_TRIES",
    "MEAN_SHARE",
    "NOISY_COST_TOLERANCE",
    "NO_PARAMETER",
    "NO_PRIORS",
    "N_OBSERVATION",
    "PLAIN_SQUARES",
    "SHARE_VARIANCE",
    "Budget",
    "BudgetSpentError",
    "CalibrationPrior",
    "Columns",
    "Damping",
    "DistanceFactors",
    "EliminationFronts",
    "FrontFactor",
    "FrontalSystem",
    "Graph",
    "GrowingProblem",
    "JointPrior",
    "Kind",
    "Linearised",
    "Loss",
    "Losses",
    "Nodes",
    "Normal",
    "NotPositiveError",
    "ObservationFactors",
    "OdometryArrays",
    "OdometryFactors",
    "Parameter",
    "Priors",
    "Problem",
    "Solution",
    "SquareRoot",
    "StartFactors",
    "State",
    "Tree",
    "Unsigned",
    "Values",
    "add_matrix",
    "add_vector",
    "add_vectors",
    "advance",
    "bias_of",
    "budgets_of",
    "build_fronts",
    "build_graph",
    "columns_of",
    "common_ancestor",
    "compiled_motions",
    "correct_bias",
    "cost_of_bias",
    "covariance_with_bias",
    "eliminate_columns",
    "ends_of",
    "error_by_wheels",
    "error_of",
    "factorise",
    "go_along",
    "huber",
    "is_of_segment",
    "loss_and_weight",
    "losses_and_weights",
    "motion_at",
    "mount_parameters_of",
    "multiply",
    "observation_factor",
    "odometry_parameters_of",
    "parameter_of_scale",
    "parameters_of_camera",
    "parameters_of_gyro",
    "parameters_of_wheels",
    "scaled_information",
    "series",
    "solve",
    "solve_with_workers",
    "stack",
    "unheld",
    "wheel_correction",
    "whitening",
    "wrap",
]
