from .csv_table import CsvTable, read_table
from .input_budget import ALONE, Inputs, size_bytes
from .jit import announce_compilation, borrow, inline, inner, njit
from .npz_file import open_arrays
from .stages import Progress, StageCost, Stages

__all__ = [
    "ALONE",
    "CsvTable",
    "Inputs",
    "Progress",
    "StageCost",
    "Stages",
    "announce_compilation",
    "borrow",
    "inline",
    "inner",
    "njit",
    "open_arrays",
    "read_table",
    "size_bytes",
]
