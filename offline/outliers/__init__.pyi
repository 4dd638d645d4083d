from .duplicate_ids import told_apart
from .local_maps import local_maps_of
from .odometry_breaks import split_where_broken
from .report import suspect_tags
from .search import FALSE_ALARM
from .split import RunsAlone, joined, renamed, split_together, with_outliers_apart

__all__ = [
    "FALSE_ALARM",
    "RunsAlone",
    "joined",
    "local_maps_of",
    "renamed",
    "split_together",
    "split_where_broken",
    "suspect_tags",
    "told_apart",
    "with_outliers_apart",
]
