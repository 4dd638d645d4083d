"""Localisation while driving: a fixed-lag smoother in a finished map, tags that moved noticed."""
