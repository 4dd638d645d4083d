from .duplicate_ids import split_duplicates
from .left_out import find_false_detections, read_as_another, stray_passes, without_tags
from .local_maps_without_outliers import local_maps_of, remove_outliers_under_own_noise
from .outliers import OutlierSearch, rename_tags, split_together, with_outliers_apart
from .report import outlier_report
from .search import FALSE_ALARM
from .split_alone import join_places

__all__ = [
    "FALSE_ALARM",
    "OutlierSearch",
    "find_false_detections",
    "join_places",
    "local_maps_of",
    "outlier_report",
    "read_as_another",
    "remove_outliers_under_own_noise",
    "rename_tags",
    "split_duplicates",
    "split_together",
    "stray_passes",
    "with_outliers_apart",
    "without_tags",
]
