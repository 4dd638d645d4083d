from .bundle_adjustment import Refined, refine
from .factors import SpatialState
from .graph import corner_graph
from .initial_tag_poses import hung_otherwise
from .multifrontal.fronts import NotPositiveError
from .solver import CornerSolution, solve_corners

__all__ = [
    "CornerSolution",
    "NotPositiveError",
    "Refined",
    "SpatialState",
    "corner_graph",
    "hung_otherwise",
    "refine",
    "solve_corners",
]
