"""Writing of run logs: single files, the sequence of files of a run, and the interface to the disk."""
