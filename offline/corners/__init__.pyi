from .bundle_adjustment import Refined, refine
from .factors import SpatialState
from .graph import corner_graph
from .initial_tag_poses import alternative_states
from .solver import CornerSolution, solve_corners

__all__ = [
    "CornerSolution",
    "Refined",
    "SpatialState",
    "alternative_states",
    "corner_graph",
    "refine",
    "solve_corners",
]
