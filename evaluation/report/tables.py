"""The tables of a report."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

from lidarslam.evaluation.comparison.comparison import (
    QUANTITIES,
    WHOLE,
    MethodResult,
    SequenceComparison,
    Table,
    TableCell,
    TableColumn,
    TableRow,
    lost_intervals,
    times_note,
)
from lidarslam.evaluation.trajectory.metrics import KITTI_LENGTHS_M, SHORT_LENGTHS_M, Drift

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


@dataclass(frozen=True)
class DriftSeries:
    """Drift of the measured methods over segment lengths, or over speeds, as far as any of them has one."""

    title: str  # of the table
    over: str  # the lengths, behind the title of a plot
    unit: str  # of the places
    per_m: int  # length that the rotation is given over
    places: Sequence[int]  # lengths or speeds
    by_method: Mapping[str, Mapping[int, Drift | None]]

    def of(self, name: str) -> tuple[list[float | None], list[float | None]]:
        """Translation in percent and rotation in degrees of a method at all places."""
        found = [self.by_method.get(name, {}).get(place) for place in self.places]
        rotations = [None if drift is None else drift.rotation_deg_per_m * self.per_m for drift in found]
        return [None if drift is None else drift.translation_percent for drift in found], rotations


def drift_series(sequence: SequenceComparison) -> list[DriftSeries]:
    """Over short segments, over KITTI's, and of these by speed; a series without any drift has no place."""
    measured = {method.name: metrics for method, metrics in sequence.measured}
    kitti = {name: metrics.kitti for name, metrics in measured.items() if metrics.kitti is not None}
    short = {name: metrics.segments for name, metrics in measured.items()}
    lengths = {name: drift.by_length for name, drift in kitti.items()}
    speeds = {name: drift.by_speed for name, drift in kitti.items()}
    title = "drift over segments of"
    series = [
        DriftSeries(f"{title} 5 to 100 m", ", 5 to 100 m", "m", 10, SHORT_LENGTHS_M, short),
        DriftSeries(f"{title} 100 to 800 m (KITTI)", ", 100 to 800 m", "m", 100, KITTI_LENGTHS_M, lengths),
        DriftSeries(f"{title} 100 to 800 m by speed", "", "m/s", 100, sorted({*chain(*speeds.values())}), speeds),
    ]
    return [
        replace(one, places=[place for place in one.places if any(of.get(place) for of in one.by_method.values())])
        for one in series
    ]


def sequence_tables(sequence: SequenceComparison) -> dict[str, list[Table]]:
    """The tables of one recording by subject; a table without any value is left out."""
    tables = {
        "summary": [_summary_table(sequence)],
        "drift": [_drift_table(sequence, series) for series in drift_series(sequence)],
        "map": [_map_table(sequence)],
        "time": [_time_table(sequence)],
        "tracking": [_lost_table(sequence)],
    }
    return {subject: [table for table in of if table.columns and table.rows] for subject, of in tables.items()}


def _summary_table(sequence: SequenceComparison) -> Table:
    quantities = [QUANTITIES[name] for name in _SUMMARY]
    columns = [TableColumn("", "Status", numeric=False), *(quantity.column() for quantity in quantities)]
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


def _drift_table(sequence: SequenceComparison, series: DriftSeries) -> Table:
    """Two decimals over KITTI's lengths, three over short ones, as papers print them."""
    digits = 2 if series.per_m == 100 else 3
    columns = [
        TableColumn(heading, f"{place} {series.unit}", digits=digits, lower_is_better=True)
        for heading in ("translation [%]", f"rotation [deg/{series.per_m} m]")
        for place in series.places
    ]
    rows = [
        TableRow(m.name, [TableCell(value, ranked=m.status in WHOLE) for value in chain(*series.of(m.name))])
        for m in sequence.methods
    ]
    return Table(f"{sequence.sequence}: {series.title}", columns, rows, folded=series.unit == "m/s")


def _map_table(sequence: SequenceComparison) -> Table:
    if all(method.map_metrics is None for method in sequence.methods):
        return Table("", [], [])
    quantities = [q for name, q in QUANTITIES.items() if name.startswith("map_") and name != "map_entropy"]
    # The title says "map" already.
    columns = [replace(q.column(), label=q.label.removeprefix("map ")) for q in quantities]
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
    columns = [q.column() for q in quantities]
    columns += [TableColumn("median of a stage", stage, "ms", 1) for stage in stages]
    rows = []
    for m in sequence.methods:
        cells = [TableCell(m.stage_ms.get(stage) or None) for stage in stages]
        rows.append(TableRow(m.name, [*(q.cell(m) for q in quantities), *cells]))
    note = " ".join(filter(None, [_TIME_NOTE, times_note(sequence.methods)]))
    return Table(f"{sequence.sequence}: time and memory", columns, rows, note).without_empty()


def _lost_table(sequence: SequenceComparison) -> Table:
    numbers = {"Lost scans": "", "First": "scan", "Last": "scan", "From": "s", "To": "s"}
    columns = [TableColumn("", label, unit, int(unit == "s")) for label, unit in numbers.items()]
    status, reason = (TableColumn("", label, numeric=False) for label in ("Status", "Reason"))
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
    return Table(f"{sequence.sequence}: tracking lost", [status, *columns, reason], rows, note, folded=True)


def _status(method: MethodResult) -> str:
    text: str = method.status
    if text == "lost":
        text = f"lost, {method.lost_scans} of {method.scans} scans" if method.lost_scans else "unreliable"
    return f"{_SYMBOLS.get(method.status, '✕')} {text}"
