"""A table as values: what stands in it, which figure is the best of its column, and where rows come from."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from evaluation.comparison.number_text import number_text


@dataclass(frozen=True)
class Column:
    """A column.

    Attributes:
        heading: with the unit in brackets.
        digits: after the decimal point, of numbers.
        lower_is_better: which end is the good one; None where neither is.
        group: columns beside one another with the same group get it as a common heading.
        numeric: whether it holds numbers, which stand flush right.
    """

    heading: str
    digits: int = 0
    lower_is_better: bool | None = None
    group: str = ""
    numeric: bool = True


@dataclass(frozen=True)
class Cell:
    """A cell.

    Attributes:
        value: a number, text as it is, or None for what could not be had.
        note: small print beside it.
        may_win: whether it is comparable with the others of its column.
        best: whether it is the best of its column.
    """

    value: float | str | None
    note: str = ""
    may_win: bool = True
    best: bool = False


@dataclass(frozen=True)
class Row:
    """A row.

    Attributes:
        cells: one a column.
        method: the method of the report whose colour the row has; empty for none.
        source: where a published row was published; empty for ours.
    """

    cells: Sequence[Cell]
    method: str = ""
    source: str = ""


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        title: a few words.
        columns, rows: the content.
        note: a sentence below it; may be empty.
        folded: whether the page shows it on request only.
    """

    title: str
    columns: Sequence[Column]
    rows: Sequence[Row]
    note: str = ""
    folded: bool = False

    def cell_text(self, row: Row, column: int) -> str:
        """The text of a cell, without its note."""
        return number_text(row.cells[column].value, self.columns[column].digits)


def with_best(table: Table) -> Table:
    """The table with the best of each column marked; all that look equal to it are marked too.

    Nothing is marked in columns that are not ranked, or that hold no two comparable numbers that differ.
    """
    rows = [list(row.cells) for row in table.rows]
    for index, column in enumerate(table.columns):
        if column.lower_is_better is None:
            continue
        ranked = {
            number: round(float(cells[index].value or 0.0), column.digits)
            for number, cells in enumerate(rows)
            if _is_ranked(cells[index])
        }
        if len(set(ranked.values())) < 2:
            continue
        best = min(ranked.values()) if column.lower_is_better else max(ranked.values())
        for number, value in ranked.items():
            if value == best:
                rows[number][index] = replace(rows[number][index], best=True)
    return replace(table, rows=[replace(row, cells=cells) for row, cells in zip(table.rows, rows, strict=True)])


def without_empty(table: Table) -> Table:
    """The table without the columns of numbers that no row has one in."""
    kept = [
        index
        for index, column in enumerate(table.columns)
        if not column.numeric or any(row.cells[index].value is not None for row in table.rows)
    ]
    return replace(
        table,
        columns=[table.columns[index] for index in kept],
        rows=[replace(row, cells=[row.cells[index] for index in kept]) for row in table.rows],
    )


def _is_ranked(cell: Cell) -> bool:
    return cell.may_win and isinstance(cell.value, float | int) and math.isfinite(cell.value)
