from .bags.importer import import_bag
from .bags.reader import is_bag
from .bags.topics import BagOptions
from .csv.importer import import_folder
from .robot import ImportOptions, placeholder_parameters
from .run_writer import ImportReport, check_output
from .wpilog.importer import import_wpilog
from .wpilog.reader import is_wpilog
from .wpilog.topics import WpilogOptions

__all__ = [
    "BagOptions",
    "ImportOptions",
    "ImportReport",
    "WpilogOptions",
    "check_output",
    "import_bag",
    "import_folder",
    "import_wpilog",
    "is_bag",
    "is_wpilog",
    "placeholder_parameters",
]
