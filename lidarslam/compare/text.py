"""Output of `lidarslam compare`: a line for each finished method, and tables at the end."""

import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path

from evaluation.comparison.comparison import Comparison, MethodResult, SequenceComparison
from evaluation.comparison.quantities import QUANTITIES, Quantity
from evaluation.comparison.table import Table, TableCell, TableColumn
from evaluation.trajectory.drift import SHORT_LENGTHS_M
from lidarslam.compare.method_ending import WHOLE
from lidarslam.compare.plan import COMPARISON, REPORT_HTML, REPORT_MD

_BEST, _NOTHING = "*", "-"
_ALWAYS = ("ate_rotation_rmse_deg", "rpe_translation_rmse_m", "ms_per_scan_median", "peak_rss_mb")


def format_result(recording: str, result: MethodResult, reused: bool = False) -> str:
    """One finished method in a line."""
    took = "" if result.wall_s is None else f" in {result.wall_s:.0f} s"
    took = f"{took}, in an earlier comparison" if reused else took
    why = f": {result.message}" if result.message else ""
    return f"{recording} {result.name}: {result.status}{took}{why}"


def format_comparison(comparison: Comparison, out: Path) -> str:
    """The tables, and where to look."""
    return "\n".join(_lines(comparison, out))


def _lines(comparison: Comparison, out: Path) -> Iterator[str]:
    tables = [list(_sequence_lines(sequence)) for sequence in comparison.sequences]
    tables += [list(_summary_lines(table)) for table in comparison.tables]
    for lines in tables:
        yield from (*lines, "")
    for missing in comparison.missing:
        yield f"left out: {missing.sequence} ({missing.reason})"
    yield from comparison.notes
    if any(_BEST in line for lines in tables for line in lines):
        yield f"{_BEST} best of its column"
    yield f"report    {out / REPORT_HTML}, {out / REPORT_MD}, {out / COMPARISON}"
    runs = [str(out / result.run) for sequence in comparison.sequences[:1] for result in sequence.methods if result.run]
    if runs:
        yield f"look      {shlex.join(['lidarslam', 'view', *runs])}"


def _sequence_lines(sequence: SequenceComparison) -> Iterator[str]:
    against = "" if sequence.reference is None else f", against {sequence.reference_name}"
    yield f"{sequence.sequence}{against}"
    results = sequence.methods
    left = [["method", *(result.name for result in results)], ["status", *(result.status for result in results)]]
    # A run that ended early is not compared with others.
    whole = [result.status in WHOLE for result in results]
    right = []
    for quantity in _shown_quantities(results):
        cells = _cells([quantity.of(result) for result in results], quantity.digits, quantity.lower_is_better, whole)
        right.append([f"{_head(quantity.label, quantity.unit)} ", *cells])
    yield from _grid(left, right)
    for result in results:
        if result.message:
            yield f"{result.name}: {result.message}"
    yield from sequence.notes


def _shown_quantities(results: Sequence[MethodResult]) -> Iterator[Quantity]:
    yield QUANTITIES["ate_rmse_m"]
    # KITTI's drift, or that over the longest segments for which the recording is long enough.
    drifts = [QUANTITIES["kitti_translation_percent"]]
    drifts += [QUANTITIES[f"segment_{length_m}_translation_percent"] for length_m in reversed(SHORT_LENGTHS_M)]
    yield next((drift for drift in drifts if any(drift.of(result) is not None for result in results)), drifts[0])
    yield from (QUANTITIES[name] for name in _ALWAYS)
    chamfer = QUANTITIES["map_chamfer_m"]
    if any(chamfer.of(result) is not None for result in results):
        yield chamfer
    yield QUANTITIES["lost_scans"]


def _summary_lines(table: Table) -> Iterator[str]:
    yield table.title
    sources = list(dict.fromkeys(row.source for row in table.rows if row.source))
    marks = [f" [{sources.index(row.source) + 1}]" if row.source else "" for row in table.rows]
    left = [["method", *(f"{row.method}{mark}" for row, mark in zip(table.rows, marks, strict=True))]]
    right = []
    for number, column in enumerate(table.columns):
        of_column = [row.cells[number] for row in table.rows]
        cells = _cells([cell.value for cell in of_column], column.digits, column.lower_is_better)
        cells = [f"{text}{_share(cell, column)}" for text, cell in zip(cells, of_column, strict=True)]
        right.append([f"{column.heading}: {_head(column.label, column.unit)} ", *cells])
    yield from _grid(left, right)
    if table.note:
        yield table.note
    for number, source in enumerate(sources, start=1):
        yield f"[{number}] {source}"


def _share(cell: TableCell, column: TableColumn) -> str:
    """Of how many recordings a mean is, where some are missing."""
    of = len(column.sequences)
    return f"({cell.averaged} of {of})" if cell.value is not None and cell.averaged < of else ""


def _head(label: str, unit: str) -> str:
    return f"{label} {unit}".strip()


def _cells(
    values: Sequence[float | str | None],
    digits: int,
    lower_is_better: bool | None,
    comparable: Sequence[bool] | None = None,
) -> list[str]:
    """Numbers with the best marked where there is a choice; the mark stands in a place of its own."""
    texts = [_NOTHING if v is None else v if isinstance(v, str) else f"{v:.{digits}f}" for v in values]
    compared = comparable or [True] * len(values)
    numbers = [v for v, counts in zip(values, compared, strict=True) if counts and isinstance(v, int | float)]
    best = None
    if lower_is_better is not None and len(numbers) > 1:
        best = f"{(min if lower_is_better else max)(numbers):.{digits}f}"
    marks = [_BEST if counts and text == best else " " for text, counts in zip(texts, compared, strict=True)]
    return [f"{text}{mark}" for text, mark in zip(texts, marks, strict=True)]


def _grid(left: Sequence[Sequence[str]], right: Sequence[Sequence[str]]) -> Iterator[str]:
    """Lines of columns: words to the left, numbers to the right."""
    columns = [[text.ljust(max(map(len, texts))) for text in texts] for texts in left]
    columns += [[text.rjust(max(map(len, texts))) for text in texts] for texts in right]
    for cells in zip(*columns, strict=True):
        yield "  ".join(cells).rstrip()
