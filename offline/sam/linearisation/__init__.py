"""Compiled linearisation of all factors into the blocks of the normal equations, and robust losses."""
