"""Results of a comparison of methods, quantities and tables: plain values for the report and comparison.json."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from lidarslam.core.geometry import FloatArray
from lidarslam.core.settings import Settings
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory
from lidarslam.evaluation.map.metrics import CloudErrors
from lidarslam.evaluation.trajectory.metrics import SHORT_LENGTHS_M, TrajectoryMetrics, metrics_json

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
        """(row, column) of the best values of each ranked column with two comparable numbers that differ."""
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


MethodStatus = Literal["ok", "lost", "stopped", "failed", "out of memory", "timed out", "not run"]
"""`lost`: finished, but tracking was lost, or the path is unreliable. `stopped`: ended early with a partial result. The
last four: no result but the message; `not run`: the comparison was interrupted before, or something is missing that it
needs."""

TimesCover = Literal["reading, registration and map", "registration"]
"""The stages that the times of a scan include."""

GROUND_TRUTH = "ground truth"
"""Name of the reference that came with a recording."""

WHOLE: tuple[MethodStatus, ...] = ("ok", "lost")
"""Statuses of a run that came to the recording's end; of any other, the figures are of a part."""

# Runs of lost scans with a shorter tracked gap between them are one interval.
_MERGED_GAP_S = 1.0


@dataclass(frozen=True, eq=False)
class ScanSeries:
    """The registration of each scan of a run, NaN where there was none."""

    times_s: FloatArray  # (N,) since the first scan
    statuses: Sequence[Status]  # N
    residual_m: FloatArray  # (N,) median distance of the matched points from their surfaces
    inlier_ratio: FloatArray  # (N,)
    points_used: FloatArray  # (N,)


@dataclass(frozen=True, eq=False)
class MethodResult:
    """One method on one recording; values that are not available are None."""

    name: str  # as the user named it, such as `kiss-icp@0.5` or `learned+map`
    # status, message: how it ended, and the reason when it did not end well
    status: MethodStatus
    message: str = ""
    scans: int = 0
    trajectory: Trajectory | None = None  # its poses, in its own world
    lost: NDArray[np.bool_] | None = None  # (N,) whether tracking was lost
    lost_reasons: Sequence[str] = ()  # one for each run of successive lost scans; empty when unknown
    metrics: TrajectoryMetrics | None = None  # its errors, with their association and alignment
    map_metrics: Mapping[str, object] | None = None  # the content of metrics.json's "map"
    map_errors: CloudErrors | None = None  # of its points, thinned for the figure
    map_entropy: float | None = None  # mean map entropy of its map, which needs no reference
    elapsed_ms_per_scan: float | None = None  # elapsed time of all scans over their number
    # latency_ms_median, latency_ms_p99: sum of the stages of one scan
    latency_ms_median: float | None = None
    latency_ms_p99: float | None = None
    # ms_per_scan_median, ms_per_scan_p95, ms_per_scan_p99: wall time from one finished scan to the next
    ms_per_scan_median: float | None = None
    ms_per_scan_p95: float | None = None
    ms_per_scan_p99: float | None = None
    times_cover: TimesCover = "reading, registration and map"  # all of the above
    # median wall time of each stage; stages run in parallel
    stage_ms: Mapping[str, float] = field(default_factory=dict)
    peak_rss_mb: float | None = None  # of its process and its children
    wall_s: float | None = None  # of the whole process, from start to end
    settings: str = ""  # the method's resolved configuration as YAML
    series: ScanSeries | None = None  # of each scan, for the page of a run
    run: str = ""  # its run directory, relative to the report's folder; empty when there is none

    @property
    def lost_scans(self) -> int | None:
        """Number of lost scans; None without a trajectory."""
        return None if self.lost is None else int(self.lost.sum())

    def to_json(self) -> dict[str, object]:
        """The method's entry in comparison.json."""
        measured = self.metrics is not None or self.map_metrics is not None
        return {
            "status": self.status,
            "message": self.message,
            "metrics": metrics_json(self.metrics, self.map_metrics) if measured else None,
            "times_cover": self.times_cover,
            **{name: getattr(self, name) for name, quantity in QUANTITIES.items() if quantity.is_time},
            "stage_ms": dict(self.stage_ms),
            "scans": self.scans,
            "lost_scans": self.lost_scans,
            "peak_rss_mb": self.peak_rss_mb,
            "wall_s": self.wall_s,
            "run": self.run or None,
        }


@dataclass(frozen=True, eq=False)
class SequenceComparison:
    """All methods on one recording."""

    sequence: str  # the recording's name
    source: str  # its path, as the user named it
    reference: Trajectory | None  # the trajectory that errors are relative to; None when there is none
    reference_name: str  # "ground truth", or the method or file that serves as the reference
    methods: Sequence[MethodResult]  # in the order asked for
    notes: Sequence[str] = ()  # remarks on this recording, such as why there is no reference

    @property
    def measured(self) -> list[tuple[MethodResult, TrajectoryMetrics]]:
        """The methods that were compared with the reference."""
        return [(method, method.metrics) for method in self.methods if method.metrics is not None]

    def to_json(self) -> dict[str, object]:
        """The content of comparison.json for one recording."""
        return {
            "sequence": self.sequence,
            "source": self.source,
            "reference": None if self.reference is None else self.reference_name,
            "notes": list(self.notes),
            "methods": {method.name: method.to_json() for method in self.methods},
        }


@dataclass(frozen=True)
class MissingRecording:
    """A recording that was asked for and is not part of the comparison."""

    # sequence, source: as in `SequenceComparison`
    sequence: str
    source: str
    reason: str  # in a sentence


@dataclass(frozen=True, eq=False)
class Comparison:
    """The content of a report."""

    title: str  # of the report
    command: str  # that reproduces it
    sequences: Sequence[SequenceComparison]  # one or more recordings
    versions: Mapping[str, str] = field(default_factory=dict)  # program -> version; "commit" when it is known
    machine: Mapping[str, str] = field(default_factory=dict)  # name -> text, such as processor, cores, memory, system
    tables: Sequence[Table] = ()  # over several recordings, published rows included; a report shows them first
    missing: Sequence[MissingRecording] = ()  # recordings that were asked for and are not there
    notes: Sequence[str] = ()  # remarks on the whole, such as that it was interrupted

    def to_json(self) -> dict[str, object]:
        """The content of comparison.json: of one recording its own keys, of several a list of them."""
        about = {
            "title": self.title,
            "command": self.command,
            "versions": dict(self.versions),
            "machine": dict(self.machine),
            "notes": list(self.notes),
        }
        if len(self.sequences) == 1 and not self.tables and not self.missing:
            (only,) = self.sequences
            return {**about, **only.to_json(), "notes": [*self.notes, *only.notes]}
        return {
            **about,
            "sequences": [sequence.to_json() for sequence in self.sequences],
            "missing": [vars(recording) for recording in self.missing],
            "tables": [table.to_json() for table in self.tables],
        }


@dataclass(frozen=True)
class LostInterval:
    """Lost scans with no tracked gap of a second or more between them."""

    # first, last: rows of the method's trajectory, both inclusive
    first: int
    last: int
    # begin_s, end_s: their times since the method's first scan
    begin_s: float
    end_s: float
    scans: int  # number of lost scans among them
    reason: str  # of the first loss, and the number of others


def look_up(figures: object, path: str) -> float | None:
    """The finite number at a path of keys separated by slashes; None where there is none."""
    for key in path.split("/"):
        figures = figures.get(key) if isinstance(figures, Mapping) else None
    return float(figures) if isinstance(figures, int | float) and math.isfinite(figures) else None


def lost_intervals(method: MethodResult) -> list[LostInterval]:
    """The intervals in order of time; none without a trajectory."""
    if method.lost is None or method.trajectory is None:
        return []
    times_s = method.trajectory.stamps - method.trajectory.stamps[:1]
    edges = np.flatnonzero(np.diff(np.r_[False, method.lost, False]))
    runs = list(zip(edges[::2].tolist(), (edges[1::2] - 1).tolist(), strict=True))
    reasons = method.lost_reasons if len(method.lost_reasons) == len(runs) else [method.message] * len(runs)
    merged: list[list[tuple[int, int, str]]] = []
    for (first, last), reason in zip(runs, reasons, strict=True):
        if not merged or times_s[first] - times_s[merged[-1][-1][1]] >= _MERGED_GAP_S:
            merged.append([])
        merged[-1].append((first, last, reason))
    intervals = []
    for stretches in merged:
        first, last, why = stretches[0][0], stretches[-1][1], stretches[0][2]
        why += f", and {len(stretches) - 1} more" if len(stretches) > 1 else ""
        scans = int(method.lost[first : last + 1].sum())
        intervals.append(LostInterval(first, last, float(times_s[first]), float(times_s[last]), scans, why))
    return intervals


_TRAJECTORY, _KITTI, _SEGMENTS, _MAP = (f"metrics/{part}/" for part in ("trajectory", "kitti", "segments", "map"))


@dataclass(frozen=True)
class Quantity:
    """One number of a method on a recording."""

    path: str  # of the keys in `MethodResult.to_json()`, separated by slashes
    label: str  # short, for the head of a column
    unit: str  # empty for counts
    digits: int  # after the decimal point
    lower_is_better: bool | None = True  # None for a quantity that is not ranked
    # path of the value that the number is given in percent of; None: it is given as it is
    percent_of: str | None = None
    is_time: bool = False  # of a scan, as far as `MethodResult.times_cover` says

    def of(self, result: MethodResult) -> float | None:
        """The number; None where there is none."""
        entry = {**result.to_json(), "map_entropy": result.map_entropy}
        value = look_up(entry, self.path)
        if self.percent_of is None or value is None:
            return value
        whole = look_up(entry, self.percent_of)
        return 100.0 * value / whole if whole else None

    def is_comparable(self, result: MethodResult) -> bool:
        """Whether the number is of the whole recording, and a time of all stages of a scan."""
        return result.status in WHOLE and not (self.is_time and result.times_cover == "registration")

    def column(self, heading: str = "", sequences: Sequence[str] = ()) -> TableColumn:
        """Its column of a table."""
        return TableColumn(heading, self.label, self.unit, self.digits, self.lower_is_better, sequences)

    def cell(self, result: MethodResult) -> TableCell:
        """The number in a table."""
        return TableCell(self.of(result), ranked=self.is_comparable(result))


def times_note(results: Iterable[MethodResult]) -> str:
    """A sentence on the methods whose times are of the registration alone; empty without any."""
    names = dict.fromkeys(result.name for result in results if result.times_cover == "registration")
    if not names:
        return ""
    return f"Times of {', '.join(names)}: registration alone, without reading and map; not ranked with the others."


QUANTITIES: dict[str, Quantity] = {
    "ate_rmse_m": Quantity(_TRAJECTORY + "ate_rmse_m", "ATE", "m", 3),
    "ate_percent_of_path": Quantity(
        _TRAJECTORY + "ate_rmse_m", "ATE", "% of path", 2, percent_of=_TRAJECTORY + "length_m"
    ),
    "ate_rotation_rmse_deg": Quantity(_TRAJECTORY + "ate_rotation_rmse_deg", "rotation", "deg", 2),
    "rpe_translation_rmse_m": Quantity(_TRAJECTORY + "rpe_translation_rmse_m", "RPE", "m", 3),
    "rpe_rotation_rmse_deg": Quantity(_TRAJECTORY + "rpe_rotation_rmse_deg", "RPE rotation", "deg", 3),
    "end_error_m": Quantity(_TRAJECTORY + "end_error_m", "end error", "m", 2),
    "kitti_translation_percent": Quantity(_KITTI + "translation_percent", "t_rel", "%", 2),
    "kitti_rotation_deg_per_100m": Quantity(_KITTI + "rotation_deg_per_100m", "r_rel", "deg/100 m", 2),
    **{
        f"segment_{m}_{key}": Quantity(f"{_SEGMENTS}{m}/{key}", f"{m} m {label}", unit, 3)
        for m in SHORT_LENGTHS_M
        for key, label, unit in (("translation_percent", "t_rel", "%"), ("rotation_deg_per_10m", "r_rel", "deg/10 m"))
    },
    "map_accuracy_mean_m": Quantity(_MAP + "accuracy_mean_m", "map accuracy", "m", 3),
    "map_completeness_mean_m": Quantity(_MAP + "completeness_mean_m", "map completeness", "m", 3),
    "map_chamfer_m": Quantity(_MAP + "chamfer_m", "map chamfer", "m", 3),
    **{
        f"map_f_score_percent_{m}": Quantity(f"{_MAP}f_score_percent/{m}", f"map F-score {m} m", "%", 1, False)
        for m in ("0.1", "0.2", "0.5")
    },
    "map_coverage_percent_1.0": Quantity(_MAP + "coverage_percent/1.0", "map coverage 1.0 m", "%", 1, False),
    "map_deviation_percent_1.0": Quantity(_MAP + "deviation_percent/1.0", "map deviation 1.0 m", "%", 1),
    "map_entropy": Quantity("map_entropy", "map entropy", "", 2),
    "elapsed_ms_per_scan": Quantity("elapsed_ms_per_scan", "elapsed", "ms/scan", 1, is_time=True),
    "latency_ms_median": Quantity("latency_ms_median", "latency (median)", "ms", 1, is_time=True),
    "latency_ms_p99": Quantity("latency_ms_p99", "latency (99 %)", "ms", 1, is_time=True),
    "ms_per_scan_median": Quantity("ms_per_scan_median", "between scans (median)", "ms/scan", 1, is_time=True),
    "ms_per_scan_p95": Quantity("ms_per_scan_p95", "between scans (95 %)", "ms/scan", 1, is_time=True),
    "ms_per_scan_p99": Quantity("ms_per_scan_p99", "between scans (99 %)", "ms/scan", 1, is_time=True),
    "odometry_ms_median": Quantity("stage_ms/odometry", "odometry", "ms/scan", 1),
    "peak_rss_mb": Quantity("peak_rss_mb", "memory", "MB", 0),
    "wall_s": Quantity("wall_s", "wall time", "s", 1),
    "lost_scans": Quantity("lost_scans", "lost scans", "", 0),
}
"""Name -> quantity, in the order of metrics.json."""


class Published(Settings):
    """A row of a published table; a value for each column, null where none was published."""

    method: str
    values: tuple[float | str | None, ...]
    source: str


class TablePlan(Settings):
    """Means over groups of recordings; a column for each group and quantity, the quantities side by side."""

    title: str
    groups: Mapping[str, tuple[str, ...]] = Field(description="heading -> names of recordings")
    quantities: tuple[str, ...]
    published: tuple[Published, ...] = ()
    note: str = ""

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        columns = len(self.groups) * len(self.quantities)
        for row in self.published:
            if len(row.values) != columns:
                raise ValueError(
                    f"table {self.title!r}, row {row.method!r}: expected {columns} values, one for each group and"
                    f" quantity, got {len(row.values)}"
                )
        unknown = next((name for name in self.quantities if name not in QUANTITIES), None)
        if unknown is not None:
            names = ", ".join(QUANTITIES)
            raise ValueError(f"table {self.title!r}: no quantity is called {unknown!r}; there are: {names}")
        return self


def mean_table(plan: TablePlan, sequences: Sequence[SequenceComparison]) -> Table:
    """The unweighted means over the recordings of each group that a method finished and has a value of."""
    chosen = [QUANTITIES[name] for name in plan.quantities]
    columns = [q.column(heading, group) for heading, group in plan.groups.items() for q in chosen]
    quantities = chosen * len(plan.groups)
    results = {(sequence.sequence, result.name): result for sequence in sequences for result in sequence.methods}
    methods = dict.fromkeys(name for _, name in results)
    rows = []
    for method in methods:
        found = [[results.get((name, method)) for name in column.sequences] for column in columns]
        rows.append(TableRow(method, [_mean(*of) for of in zip(found, quantities, strict=True)]))
    for row in plan.published:
        cells = [TableCell(v, len(of.sequences)) for v, of in zip(row.values, columns, strict=True)]
        rows.append(TableRow(row.method, cells, row.source))
    has_times = any(quantity.is_time for quantity in chosen)
    note = " ".join(filter(None, [plan.note, times_note(results.values()) if has_times else ""]))
    return Table(plan.title, columns, rows, note)


def _mean(results: Sequence[MethodResult | None], quantity: Quantity) -> TableCell:
    """A mean over fewer recordings than the column names has a note. Only comparable means are ranked."""
    finished = [result for result in results if result is not None and result.status in WHOLE]
    values = [value for result in finished if (value := quantity.of(result)) is not None]
    if not values:
        return TableCell(None, 0)
    complete = len(values) == len(results)
    comparable = complete and all(quantity.is_comparable(result) for result in finished)
    note = "" if complete else f"over {len(values)} of {len(results)}"
    return TableCell(sum(values) / len(values), len(values), note, comparable)
