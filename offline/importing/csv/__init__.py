"""CSV folders, the paper's headerless pair included, to run logs."""
