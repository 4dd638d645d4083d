from .bundle_adjustment import Refined, refine
from .factors import SpatialState
from .graph import corner_graph
from .initial_tag_poses import alternative_states
from .multifrontal.fronts import NotPositiveError
from .solver import CornerSolution, solve_corners

__all__ = [
    "CornerSolution",
    "NotPositiveError",
    "Refined",
    "SpatialState",
    "alternative_states",
    "corner_graph",
    "refine",
    "solve_corners",
]
