from .duplicate_ids import told_apart
from .local_maps import local_maps_of
from .report import suspect_tags
from .search import FALSE_ALARM
from .split import joined, renamed, split_together, with_outliers_apart

__all__ = [
    "FALSE_ALARM",
    "joined",
    "local_maps_of",
    "renamed",
    "split_together",
    "suspect_tags",
    "told_apart",
    "with_outliers_apart",
]
