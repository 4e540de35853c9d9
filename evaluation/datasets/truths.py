"""Ground truths as text: rows of three numbers, and tables with a head."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from foundation.errors import FormatError

Light = tuple[float, float, float]
"""Linear camera RGB of a light, of any length."""


def check_light(values: Sequence[float], where: str) -> Light:
    """Return a light, after checking that it is one."""
    if len(values) != 3 or not all(map(math.isfinite, values)) or min(values) < 0 or not any(values):
        raise FormatError(
            f"{where}: {' '.join(f'{value:g}' for value in values) or 'nothing'} is no light, expected red, green and "
            "blue, none below 0 and not all 0; restore the file"
        )
    red, green, blue = values
    return float(red), float(green), float(blue)


def read_text(path: Path | str) -> str:
    """Return the content of a text file."""
    try:
        return Path(path).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = (isinstance(error, OSError) and error.strerror) or str(error)
        raise FormatError(f"{path} cannot be read: {reason}; restore it from the data set's archive") from error


def numbers_in(text: str, where: str) -> list[float]:
    """Return the numbers in a text, between blanks, commas or line ends.

    Examples
    --------
    >>> numbers_in("0.5, 0.75 1e-2", "gt.txt, line 1")
    [0.5, 0.75, 0.01]
    """
    try:
        return [float(word) for word in text.replace(",", " ").split()]
    except ValueError as error:
        raise FormatError(f"{where}: {text.strip()!r} is not made of numbers; restore the file") from error


def read_lights(path: Path) -> list[Light]:
    """Return the lights of a file that has one a line, red, green, blue; empty lines at its end do not count."""
    lines = read_text(path).rstrip().splitlines()
    return [
        check_light(numbers_in(line, f"{path}, line {number}"), f"{path}, line {number}")
        for number, line in enumerate(lines, 1)
    ]


def read_light(path: Path | str) -> Light:
    """Return the light of a file that holds one, on one line or three."""
    return check_light(numbers_in(read_text(path), str(path)), str(path))


def read_rows(path: Path, needed: Sequence[str]) -> Iterator[tuple[str, Mapping[str, str]]]:
    """Yield the rows of a table, each with its place for messages."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = csv.reader(file, skipinitialspace=True)
            head = [name.strip() for name in next(rows, list[str]())]
            lacking = [name for name in needed if name not in head]
            if lacking:
                raise FormatError(
                    f"{path} has the columns {','.join(head) or 'of an empty file'}, expected "
                    f"{','.join(needed)} among them; {','.join(lacking)} is missing"
                )
            twice = [name for name in needed if head.count(name) > 1]
            if twice:
                raise FormatError(f"{path} has two columns {twice[0]!r}, expected each once; take one away")
            for row in rows:
                where = f"{path}, line {rows.line_num}"
                if not row:
                    continue
                if len(row) != len(head):
                    raise FormatError(f"{where} has {len(row)} fields, expected {len(head)} as its head; correct it")
                yield where, dict(zip(head, row, strict=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = (isinstance(error, OSError) and error.strerror) or str(error)
        raise FormatError(f"{path} cannot be read: {reason}; restore it") from error


def light_of(row: Mapping[str, str], columns: Sequence[str], where: str) -> Light:
    """Return the light in three columns of a row."""
    return check_light([number_of(row[column], where, column) for column in columns], where)


def number_of(text: str, where: str, column: str) -> float:
    """Return a field as a number."""
    try:
        return float(text)
    except ValueError as error:
        raise FormatError(f"{where}: {column} is {text!r}, expected a number; correct it") from error
