"""Output of `lidarslam compare`: a line for each finished method, and tables at the end."""

from collections.abc import Iterator
from pathlib import Path

from lidarslam.core.text import as_typed, command_line, joined
from lidarslam.evaluation.comparison.comparison import (
    Comparison,
    MethodResult,
    SequenceComparison,
    Table,
    TableCell,
    TableColumn,
    TableRow,
    number_text,
)
from lidarslam.evaluation.comparison.quantities import QUANTITIES, times_note
from lidarslam.evaluation.trajectory.drift import SHORT_LENGTHS_M
from lidarslam.storage.finished_run import COMPARISON, REPORT_HTML, REPORT_MD

_BEST = "*"
# Columns without a value are left out.
_SHOWN = (
    "ate_rotation_rmse_deg",
    "rpe_translation_rmse_m",
    "elapsed_ms_per_scan",
    "latency_ms_p99",
    "peak_rss_mb",
    "map_chamfer_m",
    "lost_scans",
)


def format_result(recording: str, result: MethodResult, reused: bool = False) -> str:
    """One finished method in a line."""
    took = "" if result.wall_s is None else f" in {result.wall_s:.0f} s"
    took = f"{took}, in an earlier comparison" if reused else took
    why = f": {result.message}" if result.message else ""
    return f"{recording} {result.name}: {result.status}{took}{why}"


def format_comparison(comparison: Comparison, out: Path) -> str:
    """The tables, and where to look."""
    return joined(_lines(comparison, out))


def _lines(comparison: Comparison, out: Path) -> Iterator[str]:
    tables = [_table(sequence) for sequence in comparison.sequences]
    for sequence, table in zip(comparison.sequences, tables, strict=True):
        yield from _table_lines(table)
        yield from (f"{result.name}: {result.message}" for result in sequence.methods if result.message)
        for result in sequence.methods:
            own = result.metrics.plugin_lines() if result.metrics is not None else ()
            yield from (f"{result.name}: {name}: {text}" for name, text in own)
        yield from (*sequence.notes, "")
    for table in comparison.tables:
        yield from (*_table_lines(table), "")
    for missing in comparison.missing:
        yield f"left out: {missing.sequence} ({missing.reason})"
    yield from comparison.notes
    if any(table.best() for table in (*tables, *comparison.tables)):
        yield f"{_BEST} best of its column"
    yield f"report    {out / REPORT_HTML}, {out / REPORT_MD}, {out / COMPARISON}"
    runs = [str(out / result.run) for sequence in comparison.sequences[:1] for result in sequence.methods if result.run]
    if runs:
        yield f"look      {command_line(as_typed('lidarslam'), 'view', *runs)}"


def _table(sequence: SequenceComparison) -> Table:
    """The methods on one recording; a run that ended early is not compared with others."""
    results = sequence.methods
    # KITTI's drift, or that over the longest segments for which the recording is long enough.
    drifts = ["kitti_translation_percent", *(f"segment_{each}_translation_percent" for each in SHORT_LENGTHS_M[::-1])]
    drift = next((name for name in drifts if any(QUANTITIES[name].of(result) is not None for result in results)), None)
    quantities = [QUANTITIES[name] for name in ("ate_rmse_m", drift or drifts[0], *_SHOWN)]
    columns = [TableColumn("", "status", numeric=False), *(quantity.column() for quantity in quantities)]
    rows = [TableRow(of.name, [TableCell(of.status), *(each.cell(of) for each in quantities)]) for of in results]
    against = "" if sequence.reference is None else f", against {sequence.reference_name}"
    return Table(f"{sequence.sequence}{against}", columns, rows, times_note(results)).without_empty()


def _table_lines(table: Table) -> Iterator[str]:
    """Lines of columns: words to the left, numbers to the right, the best of a column marked."""
    yield table.title
    best = table.best()
    sources = list(dict.fromkeys(row.source for row in table.rows if row.source))
    marks = [f" [{sources.index(row.source) + 1}]" if row.source else "" for row in table.rows]
    names = ["method", *(f"{row.method}{mark}" for row, mark in zip(table.rows, marks, strict=True))]
    columns = [[name.ljust(max(map(len, names))) for name in names]]
    for number, column in enumerate(table.columns):
        heading = f"{column.heading}: " if column.heading else ""
        texts = [f"{heading}{column.label} {column.unit}".strip() + " " * column.numeric]
        for row, each in enumerate(table.rows):
            cell = each.cells[number]
            text = number_text(cell.value, column.digits)
            mark = (_BEST if (row, number) in best else " ") if column.numeric else ""
            texts.append(f"{text}{mark}{cell.note and f'({cell.note})'}")
        width = max(map(len, texts))
        columns.append([text.rjust(width) if column.numeric else text.ljust(width) for text in texts])
    yield from ("  ".join(cells).rstrip() for cells in zip(*columns, strict=True))
    if table.note:
        yield table.note
    yield from (f"[{number}] {source}" for number, source in enumerate(sources, start=1))
