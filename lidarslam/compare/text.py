"""What `lidarslam compare` prints: a line a finished method, and tables at the end."""

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from evaluation.comparison.comparison import Comparison, MethodResult, SequenceComparison
from evaluation.comparison.quantities import QUANTITIES, Quantity
from evaluation.comparison.table import Table, TableCell, TableColumn
from evaluation.trajectory.drift import SHORT_LENGTHS_M
from lidarslam.compare.method_ending import WHOLE
from lidarslam.compare.plan import COMPARISON, REPORT_HTML, REPORT_MD

_BEST, _NOTHING = "*", "-"
_ALWAYS = ("ate_rotation_rmse_deg", "rpe_translation_rmse_m", "ms_per_scan_median", "peak_rss_mb")
_MAP = ("map_chamfer_m",)


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
        yield from lines
        yield ""
    for missing in comparison.missing:
        yield f"left out: {missing.sequence} ({missing.reason})"
    yield from comparison.notes
    if any(_BEST in line for lines in tables for line in lines):
        yield f"{_BEST} best of its column"
    yield f"report    {out / REPORT_HTML}, {out / REPORT_MD}, {out / COMPARISON}"
    runs = [str(out / result.run) for sequence in comparison.sequences[:1] for result in sequence.methods if result.run]
    if runs:
        yield f"look      {shlex.join(['lidarslam', 'view', *runs])}"


@dataclass(frozen=True)
class _Column:
    """Numbers under a heading; those of a run that ended early are not compared with others'."""

    head: str
    values: Sequence[float | str | None]
    digits: int
    lower_is_better: bool | None
    notes: Sequence[str] = ()
    comparable: Sequence[bool] = ()

    def texts(self) -> list[str]:
        """The cells, the best marked where there is anything to choose from; the mark stands in a place of its own."""
        shown = [
            _NOTHING if value is None else value if isinstance(value, str) else f"{value:.{self.digits}f}"
            for value in self.values
        ]
        comparable = self.comparable or [True] * len(shown)
        best = self._best(comparable)
        notes = self.notes or [""] * len(shown)
        return [
            f"{text}{_BEST if is_comparable and text == best else ' '}{note}"
            for text, is_comparable, note in zip(shown, comparable, notes, strict=True)
        ]

    def _best(self, comparable: Sequence[bool]) -> str | None:
        pairs = zip(self.values, comparable, strict=True)
        numbers = [value for value, counts in pairs if counts and isinstance(value, int | float)]
        if self.lower_is_better is None or len(numbers) < 2:
            return None
        return f"{(min if self.lower_is_better else max)(numbers):.{self.digits}f}"


def _sequence_lines(sequence: SequenceComparison) -> Iterator[str]:
    against = "" if sequence.reference is None else f", against {sequence.reference_name}"
    yield f"{sequence.sequence}{against}"
    results = sequence.methods
    columns = [_of(quantity, results) for quantity in _shown_quantities(results)]
    words: list[list[str]] = [[result.name for result in results], [result.status for result in results]]
    yield from _grid(["method", "status"], words, columns)
    for result in results:
        if result.message:
            yield f"{result.name}: {result.message}"
    yield from sequence.notes


def _shown_quantities(results: Sequence[MethodResult]) -> Iterator[Quantity]:
    yield QUANTITIES["ate_rmse_m"]
    yield _drift(results)
    yield from (QUANTITIES[name] for name in _ALWAYS)
    yield from (QUANTITIES[name] for name in _MAP if any(QUANTITIES[name].of(result) is not None for result in results))
    yield QUANTITIES["lost_scans"]


def _drift(results: Sequence[MethodResult]) -> Quantity:
    """KITTI's drift, or that over the longest segments for which the recording is long enough."""
    candidates = [QUANTITIES["kitti_translation_percent"]]
    candidates += [QUANTITIES[f"segment_{length_m}_translation_percent"] for length_m in reversed(SHORT_LENGTHS_M)]
    return next((each for each in candidates if any(each.of(result) is not None for result in results)), candidates[0])


def _of(quantity: Quantity, results: Sequence[MethodResult]) -> _Column:
    values = [quantity.of(result) for result in results]
    comparable = [result.status in WHOLE for result in results]
    head = _head(quantity.label, quantity.unit)
    return _Column(head, values, quantity.digits, quantity.lower_is_better, comparable=comparable)


def _head(label: str, unit: str) -> str:
    return f"{label} {unit}".strip()


def _summary_lines(table: Table) -> Iterator[str]:
    yield table.title
    columns = [
        _Column(
            f"{column.heading}: {_head(column.label, column.unit)}",
            [row.cells[number].value for row in table.rows],
            column.digits,
            column.lower_is_better,
            [_share(row.cells[number], column) for row in table.rows],
        )
        for number, column in enumerate(table.columns)
    ]
    sources = list(dict.fromkeys(row.source for row in table.rows if row.source))
    marks = [f" [{sources.index(row.source) + 1}]" if row.source else "" for row in table.rows]
    names = [f"{row.method}{mark}" for row, mark in zip(table.rows, marks, strict=True)]
    yield from _grid(["method"], [names], columns)
    if table.note:
        yield table.note
    for number, source in enumerate(sources, start=1):
        yield f"[{number}] {source}"


def _share(cell: TableCell, column: TableColumn) -> str:
    """Of how many recordings a mean is, where some are missing."""
    of = len(column.sequences)
    return f"({cell.averaged} of {of})" if cell.value is not None and cell.averaged < of else ""


def _grid(heads: Sequence[str], words: Sequence[Sequence[str]], columns: Sequence[_Column]) -> Iterator[str]:
    """Lines of columns: words to the left, numbers to the right."""
    numbers = [column.texts() for column in columns]
    left = [[head, *texts] for head, texts in zip(heads, words, strict=True)]
    right = [[f"{column.head} ", *texts] for column, texts in zip(columns, numbers, strict=True)]
    widths = [max(map(len, texts)) for texts in (*left, *right)]
    for number in range(len(left[0])):
        cells = [texts[number].ljust(width) for texts, width in zip(left, widths, strict=False)]
        cells += [texts[number].rjust(width) for texts, width in zip(right, widths[len(left) :], strict=True)]
        yield "  ".join(cells).rstrip()
