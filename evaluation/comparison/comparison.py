"""Results of a comparison of methods, and tables of them: plain values for the report and comparison.json."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory
from lidarslam.evaluation.map.metrics import CloudErrors
from lidarslam.evaluation.trajectory.metrics import TrajectoryMetrics, metrics_json

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


MethodStatus = Literal["ok", "lost", "stopped", "failed", "out of memory", "timed out", "not run"]
"""`lost`: finished, but tracking was lost on some scans. `stopped`: ended early with a partial result. The last four:
no result but the message; `not run`: the comparison was interrupted before, or something is missing that it needs."""

TimesCover = Literal["reading, registration and map", "registration"]
"""The stages that the times of a scan include."""

GROUND_TRUTH = "ground truth"
"""Name of the reference that came with a recording."""

WHOLE: tuple[MethodStatus, ...] = ("ok", "lost")
"""Statuses of a run that came to the recording's end; of any other, the figures are of a part."""

_TIMES = (
    "elapsed_ms_per_scan",
    "latency_ms_median",
    "latency_ms_p99",
    "times_cover",
    "ms_per_scan_median",
    "ms_per_scan_p95",
    "ms_per_scan_p99",
)
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
            **{name: getattr(self, name) for name in _TIMES},
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
