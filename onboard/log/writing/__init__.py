"""Writing run logs: one file, a run's sequence of files, and the disk as the writer sees it."""
