"""A table over several recordings, as papers have it: methods against columns, each cell a mean."""

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class TableColumn:
    """A column of a table over several recordings.

    Attributes:
        heading: such as "09" or "00-08".
        label, unit: of the quantity, such as "t_rel" and "%".
        digits: after the decimal point.
        lower_is_better: which end is the good one; None where neither is.
        sequences: names of the recordings that the mean is taken over.
    """

    heading: str
    label: str
    unit: str
    digits: int
    lower_is_better: bool | None
    sequences: Sequence[str]


@dataclass(frozen=True)
class TableCell:
    """A mean over recordings.

    Attributes:
        value: None when no recording has one; text as published, such as "NA".
        averaged: how many recordings the mean is of. Of a published figure, and where nothing is missing, as many as
            the column names; where it is fewer, the cell has to say so ("over 7 of 9").
    """

    value: float | str | None
    averaged: int


@dataclass(frozen=True)
class TableRow:
    """A method's line in a table.

    Attributes:
        method: ours as the user named it, others' as published.
        cells: one a column.
        source: where it was published; empty for ours.
    """

    method: str
    cells: Sequence[TableCell]
    source: str = ""


@dataclass(frozen=True)
class SummaryTable:
    """Methods against columns, over several recordings, as papers have it.

    Attributes:
        title: of the table.
        columns, rows: ours first, then the published ones.
        note: a sentence under the table, such as what the published rows were made with; may be empty.
    """

    title: str
    columns: Sequence[TableColumn]
    rows: Sequence[TableRow]
    note: str = ""

    def to_json(self) -> dict[str, object]:
        """The table in comparison.json: what a cell averages stands beside it."""
        return {
            "title": self.title,
            "note": self.note,
            "columns": [{**vars(column), "sequences": list(column.sequences)} for column in self.columns],
            "rows": [
                {"method": row.method, "source": row.source, "cells": [vars(cell) for cell in row.cells]}
                for row in self.rows
            ],
        }
