from .goodness_of_fit import joined_goodness
from .joint_solve import calibration_of, component_of
from .overdispersion import misfit_of, noise_freedom
from .pass_scatter import scatter_of_passes, scatter_warnings
from .scale_checks import COMPARED, check_warnings, checks_of, metre_of
from .solve_component import SolvedComponent, solved_component
from .tag_joins.join import TagJoin, joined_over_tags
from .tag_joins.report import join_results, join_warnings
from .tape import judged, measurement_warnings, unused
from .weak_constraints import weak_parts

__all__ = [
    "COMPARED",
    "SolvedComponent",
    "TagJoin",
    "calibration_of",
    "check_warnings",
    "checks_of",
    "component_of",
    "join_results",
    "join_warnings",
    "joined_goodness",
    "joined_over_tags",
    "judged",
    "measurement_warnings",
    "metre_of",
    "misfit_of",
    "noise_freedom",
    "scatter_of_passes",
    "scatter_warnings",
    "solved_component",
    "unused",
    "weak_parts",
]
