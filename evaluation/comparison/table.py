"""A table as values: methods against quantities; the best figure of each column is found, not stored."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

Value = float | str | None

NOT_AVAILABLE = "–"
_LONGEST_FIXED = 1e6
_UNPRINTABLE = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True)
class TableColumn:
    """A column."""

    heading: str  # common to successive columns, such as "09" or "00-08"; empty for none
    # label, unit: of the quantity, such as "t_rel" and "%"
    label: str
    unit: str = ""
    digits: int = 0  # after the decimal point
    lower_is_better: bool | None = None  # None for a column that is not ranked
    sequences: Sequence[str] = ()  # names of the recordings that the mean is taken over
    numeric: bool = True  # whether it holds numbers, which are set flush right


@dataclass(frozen=True)
class TableCell:
    """A cell."""

    value: Value  # None where it is not available; text as published, such as "NA"
    # number of recordings that a mean is taken over; of a published figure, as many as the column names
    averaged: int = 1
    note: str = ""  # next to the value, such as "over 7 of 9"
    ranked: bool = True  # whether the value is comparable with the others of its column


@dataclass(frozen=True)
class TableRow:
    """A method's row."""

    method: str  # ours as the user named it, others' as published
    cells: Sequence[TableCell]  # one per column
    source: str = ""  # where it was published; empty for ours


@dataclass(frozen=True)
class Table:
    """Methods against columns."""

    title: str  # a few words
    # columns, rows: our rows first, then the published ones
    columns: Sequence[TableColumn]
    rows: Sequence[TableRow]
    note: str = ""  # a sentence below the table; may be empty
    folded: bool = False  # whether the page shows it on request only

    def best(self) -> set[tuple[int, int]]:
        """(row, column) of the best value of each ranked column, and of all that look equal to it.

        None in a column without two comparable numbers that differ.
        """
        found = set()
        for number, column in enumerate(self.columns):
            cells = [row.cells[number] for row in self.rows]
            ranked = {i: round(float(c.value or 0.0), column.digits) for i, c in enumerate(cells) if _is_ranked(c)}
            if column.lower_is_better is not None and len(set(ranked.values())) > 1:
                best = (min if column.lower_is_better else max)(ranked.values())
                found |= {(i, number) for i, value in ranked.items() if value == best}
        return found

    def without_empty(self) -> "Table":
        """The table without the numeric columns that hold no value."""
        kept = [
            number
            for number, column in enumerate(self.columns)
            if not column.numeric or any(row.cells[number].value is not None for row in self.rows)
        ]
        rows = [replace(row, cells=[row.cells[number] for number in kept]) for row in self.rows]
        return replace(self, columns=[self.columns[number] for number in kept], rows=rows)

    def to_json(self) -> dict[str, object]:
        """The table in comparison.json, each mean with the number of recordings it is taken over."""
        keys = ("heading", "label", "unit", "digits", "lower_is_better", "sequences")
        columns = [{key: getattr(column, key) for key in keys} for column in self.columns]
        rows = [
            {
                "method": row.method,
                "source": row.source,
                "cells": [{"value": cell.value, "averaged": cell.averaged} for cell in row.cells],
            }
            for row in self.rows
        ]
        return {"title": self.title, "note": self.note, "columns": columns, "rows": rows}


def printable(text: str) -> str:
    """The text with U+FFFD for characters that neither HTML nor a file in UTF-8 can hold."""
    return _UNPRINTABLE.sub("\ufffd", text)


def number_text(value: Value, digits: int) -> str:
    """The number with this many decimals; a dash for None and non-finite values, text as it is."""
    if isinstance(value, str):
        return value
    if value is None or not math.isfinite(value):
        return NOT_AVAILABLE
    text = f"{value:.2e}" if abs(value) >= _LONGEST_FIXED else f"{value:.{digits}f}"
    return text.replace("-", "\N{MINUS SIGN}") if float(text) else text.lstrip("-")


def _is_ranked(cell: TableCell) -> bool:
    return cell.ranked and isinstance(cell.value, float | int) and math.isfinite(cell.value)
