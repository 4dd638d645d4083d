from .condensed_map import CondensedMap, condense, rotate_quarter
from .joint_fit import FitState, LinearisedFit, fit_members
from .merging import Group, Merge, PairAlignment, merge, size_rank, variance_factor
from .model_selection import CHANCE_NATS, GROUP_MARGIN, MARGIN_NATS, HypothesisTest
from .pairwise import Alignment, align
from .ransac import Hypothesis, distances, is_same_distance, transform_from_two_tags
from .tag_gate import FALSE_ALARM, TAG_GATE, gate_ratio, squared_sigmas
from .words import reason_not_joined

__all__ = [
    "CHANCE_NATS",
    "FALSE_ALARM",
    "GROUP_MARGIN",
    "MARGIN_NATS",
    "TAG_GATE",
    "Alignment",
    "CondensedMap",
    "FitState",
    "Group",
    "Hypothesis",
    "HypothesisTest",
    "LinearisedFit",
    "Merge",
    "PairAlignment",
    "align",
    "condense",
    "distances",
    "fit_members",
    "gate_ratio",
    "is_same_distance",
    "merge",
    "reason_not_joined",
    "rotate_quarter",
    "size_rank",
    "squared_sigmas",
    "transform_from_two_tags",
    "variance_factor",
]
