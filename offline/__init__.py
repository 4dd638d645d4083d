"""What runs on the laptop: run logs in, one map of all tags and trajectories out.

Data flows through the rooms in this order: `importing` and `logs` (recordings), `measurements` (front end),
`self_calibration`, `local_map`, `noise`, `alignment`, `outliers`, `global_map`, `corners`, all called by `mapping` and
solved by `sam` (back end); then `maps` (result and files), `advice`, `evaluation`, `report`, `export` and
`localization`. `commands` is the command line, `foundation` small helpers. docs/architecture.md draws it.
"""
