"""Reads CSV files as typed columns; each error has file, line, column, value and remedy."""

import csv
import io
import math
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Final, NoReturn

from groundsbot.offline.errors import OfflineError

_NS_PER_S: Final = Decimal(1_000_000_000)
_MAX_NS: Final = 2**63 - 1
_MAX_DIGITS: Final = 30  # keeps arithmetic of Decimal from overflowing


@dataclass(frozen=True)
class CsvTable:
    """The cells of one file as text.

    Attributes:
        path: path of the file.
        columns: names, in order.
        lines: the line number of each row.
        rows: the cells of each row.
    """

    path: Path
    columns: tuple[str, ...]
    lines: list[int]
    rows: list[list[str]]

    def __len__(self) -> int:
        return len(self.rows)

    def __contains__(self, column: str) -> bool:
        return column in self.columns

    def fail(self, row: int, column: str, why: str) -> NoReturn:
        """Raise the error for one cell; `why` is what is wrong with its value, and what to do.

        Raises:
            OfflineError: always.
        """
        text = self.rows[row][self.columns.index(column)]
        raise OfflineError(f"{self.path} line {self.lines[row]}, column {column}: {text!r} {why}")

    def text(self, column: str) -> list[str]:
        """Return the cells of a column as text."""
        index = self.columns.index(column)
        return [row[index] for row in self.rows]

    def numbers(self, column: str) -> list[float]:
        """Return the cells of a column as finite numbers.

        Raises:
            OfflineError: a cell is not a finite number.
        """
        values = []
        for row, text in enumerate(self.text(column)):
            try:
                value = float(text)
            except ValueError:
                self.fail(row, column, "is not a number; write one such as 0.25, or leave the row out")
            if not math.isfinite(value):
                self.fail(row, column, "is not finite; leave the row out")
            values.append(value)
        return values

    def numbers_below(self, column: str, limit: float) -> list[float]:
        """Return the cells of a column as numbers whose absolute value is below a limit.

        Raises:
            OfflineError: a cell is not such a number.
        """
        values = self.numbers(column)
        for row, value in enumerate(values):
            if not abs(value) < limit:
                self.fail(row, column, f"must be below {limit:g}; correct it, or leave the row out")
        return values

    def positive_numbers(self, column: str, limit: float = math.inf) -> list[float]:
        """Return the cells of a column as finite numbers above zero and below a limit.

        Raises:
            OfflineError: a cell is not such a number.
        """
        values = self.numbers_below(column, limit)
        for row, value in enumerate(values):
            if value <= 0.0:
                self.fail(row, column, "must be above 0; correct it, or leave the row out")
        return values

    def integers(self, column: str, minimum: int = -_MAX_NS, maximum: int = _MAX_NS) -> list[int]:
        """Return the cells of a column as integers in [minimum, maximum]; "12.0" is accepted.

        Raises:
            OfflineError: a cell is not such a number.
        """
        values = []
        for row, value in enumerate(self._decimals(column)):
            if value != value.to_integral_value():
                self.fail(row, column, "is not a whole number; correct it")
            if not minimum <= value <= maximum:
                self.fail(row, column, f"is outside {minimum} to {maximum}; correct it, or leave the row out")
            values.append(int(value))
        return values

    def stamps_ns(self, *, strictly: bool) -> list[int]:
        """Return times in ns from the column `t_ns`, or from `t_s` without rounding to floats.

        Raises:
            OfflineError: a time is below zero, or earlier than the one before; with `strictly`, also the same.
        """
        column = "t_ns" if "t_ns" in self else "t_s"
        if column == "t_ns":
            stamps = self.integers(column, minimum=0)
        else:
            stamps = [self._seconds_to_ns(row, value) for row, value in enumerate(self._decimals(column))]
        for row in range(1, len(stamps)):
            before, now = stamps[row - 1], stamps[row]
            if now < before or (strictly and now == before):
                how = "runs backwards" if now < before else "stands still"
                last = self.rows[row - 1][self.columns.index(column)]
                self.fail(row, column, f"{how} after {last!r}; sort the rows by time and leave repeated ones out")
        return stamps

    def _seconds_to_ns(self, row: int, value: Decimal) -> int:
        if not 0 <= value * _NS_PER_S <= _MAX_NS:
            self.fail(row, "t_s", "is outside 0 to 9.2e9 s; write seconds since 1970 or since the start of the run")
        return int((value * _NS_PER_S).to_integral_value())

    def _decimals(self, column: str) -> list[Decimal]:
        values = []
        for row, text in enumerate(self.text(column)):
            try:
                value = Decimal(text)
            except InvalidOperation:
                self.fail(row, column, "is not a number; write one such as 12, or leave the row out")
            if not value.is_finite() or value.adjusted() > _MAX_DIGITS:
                self.fail(row, column, "is not finite or far too large; correct it, or leave the row out")
            values.append(value)
        return values


def read_table(path: Path, headerless_columns: tuple[str, ...] | None = None) -> CsvTable:
    """Read a CSV file.

    Args:
        path: path of the file.
        headerless_columns: names of the columns; where None, the first row has them.

    Raises:
        OfflineError: the file cannot be read as text, is empty, has an empty or repeated header cell, or a row of
            another length.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise OfflineError(f"{path}: cannot be read as text: {error}; give a CSV file in UTF-8") from error
    numbered = _rows(path, text)
    if not numbered:
        raise OfflineError(f"{path}: is empty; export it again")
    if headerless_columns is None:
        line, header = numbered.pop(0)
        _check_header(path, line, header)
        columns = tuple(header)
    else:
        columns = headerless_columns
    for line, row in numbered:
        if len(row) != len(columns):
            raise OfflineError(
                f"{path} line {line}: has {len(row)} cells, needs {len(columns)} ({','.join(columns)}); "
                "complete the row, or leave it out"
            )
    return CsvTable(path, columns, [line for line, _ in numbered], [row for _, row in numbered])


def _rows(path: Path, text: str) -> list[tuple[int, list[str]]]:
    """Return the line number and stripped cells of every row that is not blank."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows = []
    try:
        for cells in reader:
            row = [cell.strip() for cell in cells]
            if len(row) > 1 or any(row):
                rows.append((reader.line_num, row))
    except csv.Error as error:
        raise OfflineError(f"{path} line {reader.line_num}: is not CSV: {error}; export it again") from error
    return rows


def _check_header(path: Path, line: int, header: list[str]) -> None:
    separators = [each for each in ";\t" if each in header[0]]
    if len(header) == 1 and separators:
        raise OfflineError(
            f"{path} line {line}: is separated by {separators[0]!r}; write the file with commas, and decimal points"
        )
    if all(_is_number(name) for name in header):
        raise OfflineError(
            f"{path} line {line}: holds the number {header[0]!r} where names of columns belong; "
            "add a first row that names them"
        )
    seen: set[str] = set()
    for name in header:
        if not name:
            raise OfflineError(f"{path} line {line}: a column has no name; name it, or leave it out")
        if name in seen:
            raise OfflineError(f"{path} line {line}: column {name!r} is there twice; leave one out")
        seen.add(name)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
