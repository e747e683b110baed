"""The tables of a report."""

from collections.abc import Mapping, Sequence

from lidarslam.evaluation.comparison.comparison import (
    WHOLE,
    Comparison,
    MethodResult,
    SequenceComparison,
    lost_intervals,
)
from lidarslam.evaluation.comparison.quantities import QUANTITIES, Quantity, times_note
from lidarslam.evaluation.comparison.table import Table, TableCell, TableColumn, TableRow
from lidarslam.evaluation.trajectory.drift import KITTI_LENGTHS_M, SHORT_LENGTHS_M, Drift

_SUMMARY = (
    "ate_rmse_m",
    "ate_rotation_rmse_deg",
    "rpe_translation_rmse_m",
    "rpe_rotation_rmse_deg",
    "end_error_m",
    "kitti_translation_percent",
    "kitti_rotation_deg_per_100m",
    "map_f_score_percent_0.2",
    "map_entropy",
    "elapsed_ms_per_scan",
    "peak_rss_mb",
)
_TIME = ("elapsed_ms_per_scan", "latency_ms_median", "latency_ms_p99", "peak_rss_mb", "wall_s")
_TIME_NOTE = (
    "Elapsed: time of all scans over their number, with reading and map. Latency: sum of the stages of one scan; stages"
    " of successive scans overlap, so that it exceeds the elapsed time. Wall time: of the whole process."
)
_SYMBOLS = {"ok": "✓", "lost": "△", "stopped": "◐"}
_MOST_INTERVALS = 40

_Drifts = Mapping[str, Mapping[int, Drift | None]]


def sequence_tables(sequence: SequenceComparison) -> dict[str, list[Table]]:
    """The tables of one recording by subject; a table without any value is left out."""
    measured = [(method.name, method.metrics) for method in sequence.methods if method.metrics is not None]
    short = {name: metrics.segments for name, metrics in measured}
    kitti = {name: metrics.kitti for name, metrics in measured if metrics.kitti is not None}
    lengths = {name: drift.by_length for name, drift in kitti.items()}
    speeds = {name: drift.by_speed for name, drift in kitti.items()}
    reached = sorted({mps for by_speed in speeds.values() for mps, drift in by_speed.items() if drift is not None})
    tables = {
        "summary": [_summary_table(sequence)],
        "drift": [
            _drift_table(sequence, "drift over segments of 5 to 100 m", short, SHORT_LENGTHS_M, "m", 10),
            _drift_table(sequence, "drift over segments of 100 to 800 m (KITTI)", lengths, KITTI_LENGTHS_M, "m", 100),
            _drift_table(sequence, "drift over segments of 100 to 800 m by speed", speeds, reached, "m/s", 100),
        ],
        "map": [_map_table(sequence)],
        "time": [_time_table(sequence)],
        "tracking": [_lost_table(sequence)],
    }
    return {subject: [table for table in of if table.columns and table.rows] for subject, of in tables.items()}


def published_table(comparison: Comparison) -> Table | None:
    """Published figures that are in no other table; None when there are none."""
    headings = list(dict.fromkeys(heading for row in comparison.published for heading in row.values))
    rows = [
        TableRow(row.method, [TableCell(_as_published(row.values.get(heading))) for heading in headings], row.source)
        for row in comparison.published
    ]
    columns = [TableColumn("", heading, digits=2) for heading in headings]
    note = "Quoted from their sources; none of these methods was run here."
    return Table("Published figures", columns, rows, note) if rows else None


def _as_published(value: float | str | None) -> float | str | None:
    """A quoted figure keeps all its decimals."""
    return f"{value:g}" if isinstance(value, float | int) and round(value, 2) != value else value


def _summary_table(sequence: SequenceComparison) -> Table:
    quantities = [QUANTITIES[name] for name in _SUMMARY]
    columns = [TableColumn("", "Status", numeric=False), *map(_column, quantities)]
    rows = [
        TableRow(m.name, [TableCell(_status(m), note=m.message), *(q.cell(m) for q in quantities)])
        for m in sequence.methods
    ]
    partial = any(method.status not in WHOLE and method.metrics is not None for method in sequence.methods)
    early = "The errors of a method that ended early are those of its part, and are not ranked." if partial else ""
    note = " ".join(filter(None, [early, times_note(sequence.methods)]))
    return Table(
        f"{sequence.sequence}: {'all methods' if len(sequence.methods) > 1 else 'summary'}", columns, rows, note
    ).without_empty()


def _drift_table(
    sequence: SequenceComparison, title: str, drifts: _Drifts, places: Sequence[int], unit: str, per_m: int
) -> Table:
    """Two decimals over KITTI's lengths, three over short ones, as papers print them."""
    reached = [place for place in places if any(by_place.get(place) for by_place in drifts.values())]
    digits = 2 if per_m == 100 else 3
    columns = [
        TableColumn(heading, f"{place} {unit}", digits=digits, lower_is_better=True)
        for heading in ("translation [%]", f"rotation [deg/{per_m} m]")
        for place in reached
    ]
    rows = []
    for method in sequence.methods:
        found = [drifts.get(method.name, {}).get(place) for place in reached]
        values = [None if drift is None else drift.translation_percent for drift in found]
        values += [None if drift is None else drift.rotation_deg_per_m * per_m for drift in found]
        rows.append(TableRow(method.name, [TableCell(value, ranked=method.status in WHOLE) for value in values]))
    return Table(f"{sequence.sequence}: {title}", columns, rows, folded=unit == "m/s")


def _map_table(sequence: SequenceComparison) -> Table:
    if all(method.map_metrics is None for method in sequence.methods):
        return Table("", [], [])
    quantities = [q for name, q in QUANTITIES.items() if name.startswith("map_") and name != "map_entropy"]
    columns = [_column(quantity, prefix="map ") for quantity in quantities]
    rows = [TableRow(m.name, [quantity.cell(m) for quantity in quantities]) for m in sequence.methods]
    note = (
        "Accuracy: mean distance of the map from the reference map; completeness: of the reference map from the map;"
        " chamfer: mean of the two. Coverage: share of the reference map within the tolerance of the map; deviation:"
        " share of the map beyond the tolerance."
    )
    return Table(f"{sequence.sequence}: map against the reference map", columns, rows, note).without_empty()


def _time_table(sequence: SequenceComparison) -> Table:
    """A stage that did not run has no time; stages are not ranked, as methods divide their work differently."""
    stages = dict.fromkeys(stage for method in sequence.methods for stage, ms in method.stage_ms.items() if ms > 0.0)
    quantities = [QUANTITIES[name] for name in _TIME]
    columns = [*map(_column, quantities), *(TableColumn("median of a stage", stage, "ms", 1) for stage in stages)]
    rows = [
        TableRow(
            m.name,
            [*(q.cell(m) for q in quantities), *(TableCell(m.stage_ms.get(stage) or None) for stage in stages)],
        )
        for m in sequence.methods
    ]
    note = " ".join(filter(None, [_TIME_NOTE, times_note(sequence.methods)]))
    return Table(f"{sequence.sequence}: time and memory", columns, rows, note).without_empty()


def _lost_table(sequence: SequenceComparison) -> Table:
    """Intervals of lost tracking and the reasons of failures."""
    heads = (("Status", "", False), ("Lost scans", "", True), ("First", "scan", True), ("Last", "scan", True))
    times = (("From", "s", True), ("To", "s", True), ("Reason", "", False))
    columns = [
        TableColumn("", label, unit, int(unit == "s"), numeric=numeric) for label, unit, numeric in (*heads, *times)
    ]
    rows = []
    for method in sequence.methods:
        intervals = lost_intervals(method)
        lines: list[tuple[float | str | None, ...]] = [
            (i.scans, i.first, i.last, i.begin_s, i.end_s, i.reason) for i in intervals[:_MOST_INTERVALS]
        ]
        if len(intervals) > _MOST_INTERVALS:
            lines.append((*[None] * 5, f"and {len(intervals) - _MOST_INTERVALS} more intervals"))
        if not intervals and method.status != "ok":
            lines.append((*[None] * 5, method.message))
        rows += [TableRow(method.name, [TableCell(method.status), *map(TableCell, line)]) for line in lines]
    note = (
        "Scans are numbered from 0; times since the method's first scan. Losses less than 1 s apart are one interval."
    )
    return Table(f"{sequence.sequence}: tracking lost", columns, rows, note, folded=True)


def _column(quantity: Quantity, prefix: str = "") -> TableColumn:
    """A prefix of the label that the table's title has already is dropped."""
    label = quantity.label.removeprefix(prefix)
    return TableColumn("", label, quantity.unit, quantity.digits, quantity.lower_is_better)


def _status(method: MethodResult) -> str:
    lost = f", {method.lost_scans} of {method.scans} scans" if method.status == "lost" and method.lost_scans else ""
    return f"{_SYMBOLS.get(method.status, '✕')} {method.status}{lost}"
