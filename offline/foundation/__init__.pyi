from .csv_table import CsvTable, read_table
from .input_budget import ALONE, Inputs, size_bytes
from .jit import announce_compilation, borrow, inline, inner, njit
from .npz_file import open_arrays
from .stages import Progress, StageCost, Stages
from .workers import ResidentItems, Workers, default_workers, worker_processes

__all__ = [
    "ALONE",
    "CsvTable",
    "Inputs",
    "Progress",
    "ResidentItems",
    "StageCost",
    "Stages",
    "Workers",
    "announce_compilation",
    "borrow",
    "default_workers",
    "inline",
    "inner",
    "njit",
    "open_arrays",
    "read_table",
    "size_bytes",
    "worker_processes",
]
