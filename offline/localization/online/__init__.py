"""Online localization in a finished map: an incremental smoother that also detects tags that moved."""
