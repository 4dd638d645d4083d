"""One problem in parts, each of some drives, that are solved together by workers.

A part eliminates its poses; what remains is the Schur complement on what it has in common with other parts: tags,
calibration, and the starts of its segments. These complements are added in a tree, one process solves their sum, and
the parts substitute back. In the paper this is the elimination of each robot's trajectory.
"""
