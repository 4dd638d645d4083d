"""Layout of panels for Foxglove and Lichtblick."""
