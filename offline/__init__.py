"""What runs on the laptop: run logs in, one map of all tags and trajectories out.

Data flows through the rooms in this order: `importing` and `logs` (recordings), `measurements` (front end), `sam` (back
end), `local_map`, `noise`, `alignment`, `outliers`, `self_calibration`, `global_map`, `corners`, put in order by
`mapping`; then `maps` (result and files), `advice`, `evaluation`, `report`, `export` and `localization`. `commands` is
the command line, `foundation` small helpers. docs/architecture.md draws it.
"""
