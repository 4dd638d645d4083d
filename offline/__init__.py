"""What runs on the laptop: run logs in, one map of all tags and trajectories out."""
