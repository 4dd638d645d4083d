from .duplicate_ids import told_apart
from .left_out import phantoms, read_as_another, stray_passes, without_tags
from .local_maps_without_outliers import judged_under_own_noise, local_maps_of
from .outliers import Searched, joined, renamed, split_together, with_outliers_apart
from .report import suspect_tags
from .search import FALSE_ALARM

__all__ = [
    "FALSE_ALARM",
    "Searched",
    "joined",
    "judged_under_own_noise",
    "local_maps_of",
    "phantoms",
    "read_as_another",
    "renamed",
    "split_together",
    "stray_passes",
    "suspect_tags",
    "told_apart",
    "with_outliers_apart",
    "without_tags",
]
