from .bags.importer import import_bag
from .bags.reader import is_bag
from .bags.topics import BagOptions
from .csv.importer import import_folder
from .robot import ImportOptions

__all__ = [
    "BagOptions",
    "ImportOptions",
    "import_bag",
    "import_folder",
    "is_bag",
]
