"""A few lines of the program that protect from a fault, and how to take them out."""

from typing import NamedTuple


class Protection(NamedTuple):
    """Some text of a file of the program, and its replacement without the protection."""

    row: str
    what: str  # is taken out, in words
    file: str
    old: str
    new: str
    test: str = ""  # a word of the test's name that is enough to run; all of the row's where empty

    def take_out_of(self, source: str) -> str:
        """The file's text without the protection.

        Raises:
            ValueError: the text is not there, or not just once.
        """
        if source.count(self.old) != 1:
            raise ValueError(f"row {self.row}: {self.file} holds {self.old!r} {source.count(self.old)} times")
        return source.replace(self.old, self.new)
