from .duplicate_ids import told_apart
from .local_maps_without_outliers import judged_under_own_noise, local_maps_of
from .outliers import joined, renamed, split_together, with_outliers_apart
from .report import suspect_tags
from .search import FALSE_ALARM

__all__ = [
    "FALSE_ALARM",
    "joined",
    "judged_under_own_noise",
    "local_maps_of",
    "renamed",
    "split_together",
    "suspect_tags",
    "told_apart",
    "with_outliers_apart",
]
