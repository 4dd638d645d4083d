from .csv_table import CsvTable, read_table
from .input_budget import ALONE, Inputs, size_bytes
from .jit import borrowed, compilation_announced, inlined, inner, jitted
from .npz_file import open_arrays
from .stages import Progress, StageCost, Stages

__all__ = [
    "ALONE",
    "CsvTable",
    "Inputs",
    "Progress",
    "StageCost",
    "Stages",
    "borrowed",
    "compilation_announced",
    "inlined",
    "inner",
    "jitted",
    "open_arrays",
    "read_table",
    "size_bytes",
]
