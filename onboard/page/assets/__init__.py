"""The page itself, with its style and script."""
