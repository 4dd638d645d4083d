from .edges import edges_of
from .goodness_of_fit import joint_goodness_of_fit
from .joint_solve import calibration_of, component_of, cross_covariances_of
from .overdispersion import misfit_of, noise_degrees_of_freedom
from .pass_scatter import scatter_of_passes, scatter_warnings
from .scale_checks import COMPARED_PARAMETERS, compare_wheels_and_tags, comparison_warnings, scale_budget
from .solve_component import SolvedComponent, solve_group
from .tag_joins.join import TagJoin, join_over_tags
from .tag_joins.report import join_results, join_warnings
from .tape import compare_distances, compare_measurements, measurement_warnings, unused_measurements
from .weak_constraints import weak_constraint_warnings

__all__ = [
    "COMPARED_PARAMETERS",
    "SolvedComponent",
    "TagJoin",
    "calibration_of",
    "compare_distances",
    "compare_measurements",
    "compare_wheels_and_tags",
    "comparison_warnings",
    "component_of",
    "cross_covariances_of",
    "edges_of",
    "join_over_tags",
    "join_results",
    "join_warnings",
    "joint_goodness_of_fit",
    "measurement_warnings",
    "misfit_of",
    "noise_degrees_of_freedom",
    "scale_budget",
    "scatter_of_passes",
    "scatter_warnings",
    "solve_group",
    "unused_measurements",
    "weak_constraint_warnings",
]
