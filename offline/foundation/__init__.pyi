from .cluster import cluster_workers
from .cluster_task import worker_name
from .compilation import compile_ahead
from .csv_table import CsvTable, read_table
from .jit import announce_compilation, borrow, inline, inner, njit
from .kernel_types import BoolVector, FloatBlocks, FloatMatrix, FloatVector, IndexMatrix, IntMatrix, IntVector
from .message_file import TimedMessage, write_messages
from .npz_file import open_arrays
from .process_start import end_quickly
from .remote_log import RemoteLog, find_remote_logs, local_copy, log_path, log_size
from .stages import Progress, StageCost, Stages, release_memory
from .workers import Handle, ResidentItems, TaskWorkers, Workers, default_workers, possible_workers, worker_processes

__all__ = [
    "BoolVector",
    "CsvTable",
    "FloatBlocks",
    "FloatMatrix",
    "FloatVector",
    "Handle",
    "IndexMatrix",
    "IntMatrix",
    "IntVector",
    "Progress",
    "RemoteLog",
    "ResidentItems",
    "StageCost",
    "Stages",
    "TaskWorkers",
    "TimedMessage",
    "Workers",
    "announce_compilation",
    "borrow",
    "cluster_workers",
    "compile_ahead",
    "default_workers",
    "end_quickly",
    "find_remote_logs",
    "inline",
    "inner",
    "local_copy",
    "log_path",
    "log_size",
    "njit",
    "open_arrays",
    "possible_workers",
    "read_table",
    "release_memory",
    "worker_name",
    "worker_processes",
    "write_messages",
]
