"""The tables over all recordings, published figures, what is missing, and what everything was made with."""

from evaluation.comparison.comparison import Comparison
from evaluation.comparison.summary_table import SummaryTable, TableCell, TableColumn
from evaluation.comparison.table import Cell, Column, Row, Table, with_best

_AS_PUBLISHED_DIGITS = 2
_METHOD = Column("Method", numeric=False)


def overview_tables(comparison: Comparison) -> list[Table]:
    """The tables over several recordings, then published rows that stand in none of these."""
    tables = [_mean_table(table) for table in comparison.tables]
    return [*tables, _published_table(comparison)] if comparison.published else tables


def missing_table(comparison: Comparison) -> Table | None:
    """Recordings that were asked for and are not there; None when all are."""
    if not comparison.missing:
        return None
    columns = [Column(heading, numeric=False) for heading in ("Recording", "Source", "Why it is left out")]
    rows = [Row([Cell(missing.sequence), Cell(missing.source), Cell(missing.reason)]) for missing in comparison.missing]
    return Table("Recordings left out", columns, rows)


def made_with_tables(comparison: Comparison) -> list[Table]:
    """Versions of the programs, the commit, and the machine."""
    named = [
        ("Versions", "Program", "Version", comparison.versions),
        ("Machine", "Part", "What it is", comparison.machine),
    ]
    return [
        Table(
            title,
            [Column(heading, numeric=False) for heading in (first, second)],
            [Row([Cell(name), Cell(text)]) for name, text in texts.items()],
        )
        for title, first, second, texts in named
        if texts
    ]


def settings_texts(comparison: Comparison) -> list[tuple[str, str]]:
    """Each different configuration with the methods and recordings it was used for."""
    used: dict[tuple[str, str], list[str]] = {}
    for sequence in comparison.sequences:
        for method in sequence.methods:
            if method.settings:
                used.setdefault((method.name, method.settings), []).append(sequence.sequence)
    return [(f"{name} ({', '.join(sequences)})", text) for (name, text), sequences in used.items()]


def _mean_table(summary: SummaryTable) -> Table:
    methods = [_METHOD, *(_mean_column(column) for column in summary.columns)]
    rows = [
        Row(
            [Cell(row.method), *(_mean_cell(c, column) for c, column in zip(row.cells, summary.columns, strict=True))],
            method="" if row.source else row.method,
            source=row.source,
        )
        for row in summary.rows
    ]
    return with_best(Table(summary.title, methods, rows, _mean_note(summary)))


def _mean_column(column: TableColumn) -> Column:
    unit = f" [{column.unit}]" if column.unit else ""
    return Column(f"{column.label}{unit}", column.digits, column.lower_is_better, group=column.heading)


def _mean_cell(cell: TableCell, column: TableColumn) -> Cell:
    """A mean over fewer recordings says so, and is not ranked with the others."""
    if cell.value is None or cell.averaged >= len(column.sequences):
        return Cell(cell.value)
    return Cell(cell.value, f"over {cell.averaged} of {len(column.sequences)}", may_win=False)


def _mean_note(summary: SummaryTable) -> str:
    partial = any(
        cell.value is not None and cell.averaged < len(column.sequences)
        for row in summary.rows
        for cell, column in zip(row.cells, summary.columns, strict=True)
    )
    said = [summary.note] if summary.note else []
    said += ["Means over fewer recordings than the column names are not ranked."] if partial else []
    said += (
        ["Rows marked as published are quoted from their source."] if any(row.source for row in summary.rows) else []
    )
    return " ".join(said)


def _as_published(value: float | str | None) -> float | str | None:
    """A figure with all the decimals it has: what is quoted is not rounded."""
    rounded = isinstance(value, float | int) and round(value, _AS_PUBLISHED_DIGITS) != value
    return f"{value:g}" if rounded else value


def _published_table(comparison: Comparison) -> Table:
    headings = list(dict.fromkeys(heading for row in comparison.published for heading in row.values))
    columns = [_METHOD, *(Column(heading, _AS_PUBLISHED_DIGITS) for heading in headings)]
    rows = [
        Row(
            [Cell(row.method), *(Cell(_as_published(row.values.get(heading))) for heading in headings)],
            source=row.source,
        )
        for row in comparison.published
    ]
    return Table("Published figures", columns, rows, "Quoted from their sources; nothing of this table was run here.")
