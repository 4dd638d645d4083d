"""CSV folders, including the paper's headerless pair of files, to run logs."""
