from .condensed_map import CondensedMap, condense, rotate_quarter
from .joint_fit import Bend, Linear, hold
from .merging import Group, Merge, PairAlignment, merge, size_rank, variance_factor
from .model_selection import CHANCE_NATS, GROUP_MARGIN, MARGIN_NATS, Rivalry
from .pairwise import Alignment, align
from .ransac import Explanation, distances, is_same_distance, through
from .tag_gate import FALSE_ALARM, TAG_GATE, ill_fitting, squared_sigmas
from .words import reason_not_joined

__all__ = [
    "CHANCE_NATS",
    "FALSE_ALARM",
    "GROUP_MARGIN",
    "MARGIN_NATS",
    "TAG_GATE",
    "Alignment",
    "Bend",
    "CondensedMap",
    "Explanation",
    "Group",
    "Linear",
    "Merge",
    "PairAlignment",
    "Rivalry",
    "align",
    "condense",
    "distances",
    "hold",
    "ill_fitting",
    "is_same_distance",
    "merge",
    "reason_not_joined",
    "rotate_quarter",
    "size_rank",
    "squared_sigmas",
    "through",
    "variance_factor",
]
