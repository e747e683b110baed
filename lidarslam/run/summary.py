"""A run in a few numbers."""

import resource
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.core.tracking import Status
from lidarslam.pipeline.loop_closing import GraphOutcome, LoopReport
from lidarslam.pipeline.pipeline import STAGES
from lidarslam.run.scan_log import ScanLog
from mapping.slides.slides import Contradiction

# A time between scans that is longer than usual by so much of it, and so many seconds, is a gap.
_PAUSE_OF_STEP = 2.0
_SHORTEST_PAUSE_S = 0.3


@dataclass(frozen=True)
class Milliseconds:
    """Time per scan: half of the scans take no longer than the median, 95 % no longer than p95."""

    median: float
    p95: float

    @classmethod
    def of(cls, values: Sequence[float] | FloatArray) -> "Milliseconds":
        """Of times that were measured, at least one."""
        return cls(float(np.median(values)), float(np.percentile(values, 95.0)))


@dataclass(frozen=True)
class LostStretch:
    """Successive scans on which tracking was lost: indices, stamps and the first one's reason."""

    first: int
    last: int
    first_stamp: float
    last_stamp: float
    reason: str


@dataclass(frozen=True)
class GraphSummary:
    """The pose graph of a run.

    Attributes:
        keyframes, edges: how many.
        loops: the closures, and what was looked at closely and refused.
        largest_correction_m: by how much a scan's position changed.
        ms_per_keyframe: on a thread of its own; None when there was none.
    """

    keyframes: int
    edges: int
    loops: tuple[LoopReport, ...]
    largest_correction_m: float
    ms_per_keyframe: Milliseconds | None

    @classmethod
    def of(cls, closed: GraphOutcome) -> "GraphSummary":
        """Of what became of a graph."""
        return cls(
            keyframes=len(closed.keyframe_poses),
            edges=len(closed.edges),
            loops=closed.loops,
            largest_correction_m=closed.largest_correction_m,
            ms_per_keyframe=Milliseconds.of(closed.keyframe_ms) if closed.keyframe_ms else None,
        )

    @property
    def closed(self) -> int:
        """How many loops were closed."""
        return sum(loop.accepted for loop in self.loops)

    def to_json(self) -> dict[str, Any]:
        """The section of summary.json."""
        return {
            "keyframes": self.keyframes,
            "edges": self.edges,
            "largest_correction_m": self.largest_correction_m,
            "ms_per_keyframe": None if self.ms_per_keyframe is None else vars(self.ms_per_keyframe),
            "loops": [loop.to_json() for loop in self.loops],
        }


@dataclass(frozen=True)
class WrittenMap:
    """A map as it was written: its points and the size of its voxels, None without a map; and what was left out.

    `moved` counts the points where something was that had moved away. `entropy` is the mean map entropy, None where it
    cannot be computed; see `evaluation.map.entropy`.
    """

    points: int
    voxel_size_m: float | None
    moved: int
    entropy: float | None = None


@dataclass(frozen=True)
class RunSummary:
    """What summary.json holds; the contract names the keys.

    `ms_per_scan["total"]` is the time from one finished scan to the next. Stages run beside one another, so they add up
    to more.
    """

    scans: int
    length_m: float
    duration_s: float
    elapsed_s: float
    ms_per_scan: dict[str, Milliseconds]
    realtime_factor: float | None
    peak_rss_mb: float
    lost: tuple[LostStretch, ...]
    degraded_scans: int
    graph: GraphSummary | None
    map: WrittenMap
    warnings: tuple[str, ...]
    contradictions: tuple[Contradiction, ...] = ()

    @property
    def went_astray(self) -> bool:
        """Whether tracking was lost: by a scan's own status, or because the map contradicts itself."""
        return bool(self.lost_scans or self.contradictions)

    @property
    def lost_scans(self) -> int:
        """How many scans were lost."""
        return sum(stretch.last - stretch.first + 1 for stretch in self.lost)

    def to_json(self) -> dict[str, Any]:
        """The content of summary.json."""
        return {
            "scans": self.scans,
            "length_m": self.length_m,
            "duration_s": self.duration_s,
            "elapsed_s": self.elapsed_s,
            "ms_per_scan": {stage: vars(ms) for stage, ms in self.ms_per_scan.items()},
            "realtime_factor": self.realtime_factor,
            "peak_rss_mb": self.peak_rss_mb,
            "lost_scans": self.lost_scans,
            "lost": [vars(stretch) for stretch in self.lost],
            "degraded_scans": self.degraded_scans,
            "map_contradictions": [vars(found) for found in self.contradictions],
            **_of_graph_and_map(self),
        }


@dataclass(frozen=True)
class MergedRecording:
    """One of several recordings that were to become one map.

    Attributes:
        name: of the recording.
        directory: of its run, beside the common map; None when there is none, for lack of a scan.
        source: where it lies.
        scans, length_m, lost_scans: of its run.
        joined: whether its poses are in the common frame.
    """

    name: str
    directory: str | None
    source: str
    scans: int
    length_m: float
    lost_scans: int
    joined: bool


@dataclass(frozen=True)
class MergeSummary:
    """What the summary.json of several recordings in one map holds."""

    recordings: tuple[MergedRecording, ...]
    elapsed_s: float
    peak_rss_mb: float
    graph: GraphSummary | None
    map: WrittenMap
    warnings: tuple[str, ...]

    @property
    def lost_scans(self) -> int:
        """How many scans were lost, of all recordings."""
        return sum(recording.lost_scans for recording in self.recordings)

    def to_json(self) -> dict[str, Any]:
        """The content of summary.json."""
        return {
            "recordings": [vars(recording) for recording in self.recordings],
            "elapsed_s": self.elapsed_s,
            "peak_rss_mb": self.peak_rss_mb,
            "lost_scans": self.lost_scans,
            **_of_graph_and_map(self),
        }


def _of_graph_and_map(summary: RunSummary | MergeSummary) -> dict[str, Any]:
    """What the summary.json of a run and of several say alike."""
    return {
        "loop_closures": 0 if summary.graph is None else summary.graph.closed,
        "pose_graph": None if summary.graph is None else summary.graph.to_json(),
        "map_points": summary.map.points,
        "map_voxel_size_m": summary.map.voxel_size_m,
        "map_points_moved": summary.map.moved,
        "map_entropy": summary.map.entropy,
        "warnings": list(summary.warnings),
    }


def summarise(
    log: ScanLog,
    total_ms: list[float],
    written: WrittenMap,
    skipped: int,
    closed: GraphOutcome | None = None,
    contradictions: tuple[Contradiction, ...] = (),
) -> RunSummary:
    """Sum a run up.

    Args:
        log: its scans.
        total_ms: wall time of each scan, from the one before finished to this one finished.
        written: the map.
        skipped: scans that were asked for and did not come, for no reason that the log warns of.
        closed: what its pose graph did to it, if it had one.
        contradictions: where its map contradicts itself.
    """
    trajectory = log.trajectory
    stages = {"total": total_ms} | dict(zip(STAGES, log.stage_ms.T, strict=True))
    elapsed_s = sum(total_ms) / 1e3
    return RunSummary(
        scans=len(log),
        length_m=trajectory.length_m,
        duration_s=trajectory.duration_s,
        elapsed_s=elapsed_s,
        ms_per_scan={stage: Milliseconds.of(values) for stage, values in stages.items()},
        realtime_factor=trajectory.duration_s / elapsed_s if elapsed_s > 0.0 and len(log) > 1 else None,
        peak_rss_mb=peak_rss_mb(),
        lost=_lost_stretches(log),
        degraded_scans=log.statuses.count(Status.DEGRADED),
        graph=None if closed is None else GraphSummary.of(closed),
        map=written,
        warnings=(*_warnings(log, skipped), *_contradicted(contradictions)),
        contradictions=contradictions,
    )


def _lost_stretches(log: ScanLog) -> tuple[LostStretch, ...]:
    stretches = []
    for status, group in groupby(range(len(log)), key=lambda index: log.statuses[index]):
        indices = list(group)
        if status is Status.LOST:
            first, last = indices[0], indices[-1]
            stretches.append(LostStretch(first, last, log.stamps[first], log.stamps[last], log.messages[first]))
    return tuple(stretches)


def _warnings(log: ScanLog, skipped: int) -> tuple[str, ...]:
    warnings = list(log.warnings)
    if skipped:
        warnings.append(f"{skipped} scans that were asked for did not come")
    warnings.extend(_pauses(log))
    if log.points_dropped:
        share = log.points_dropped / max(1, len(log))
        warnings.append(
            f"{log.points_dropped} invalid points (NaN, at the origin, out of range) were left out, {share:.0f} a scan"
        )
    if degraded := log.statuses.count(Status.DEGRADED):
        warnings.append(f"{degraded} scans are believed only in part (status degraded; scans.csv says why)")
    return tuple(warnings)


def _contradicted(contradictions: tuple[Contradiction, ...]) -> Iterator[str]:
    """Where the map contradicts itself, the clearest place spelt out."""
    if not contradictions:
        return
    clearest = max(contradictions, key=lambda found: found.votes - found.votes_at_pose)
    more = f"; {len(contradictions) - 1} more such stretches" if len(contradictions) > 1 else ""
    farther = "farther on" if clearest.shift_m > 0.0 else "farther back"
    yield (
        f"the map contradicts itself between scans {clearest.first} and {clearest.last}: held against one another, they"
        f" fit {abs(clearest.shift_m):.1f} m {farther} along the way, not at their poses, as after a slip of"
        f" registration{more}"
    )


def _pauses(log: ScanLog) -> Iterator[str]:
    """Where scans are missing, by the stamps; a pause is told by its length beside the usual time between scans."""
    steps = np.diff(log.stamps)
    usual_s = float(np.median(steps)) if len(steps) else 0.0
    pauses = np.flatnonzero(steps > usual_s + max(_PAUSE_OF_STEP * usual_s, _SHORTEST_PAUSE_S))
    if len(pauses):
        longest = int(pauses[np.argmax(steps[pauses])])
        yield (
            f"{len(pauses)} gaps in the stamps, where scans are missing or a clock was set; the longest:"
            f" {steps[longest]:.1f} s after scan {longest}"
        )


def peak_rss_mb() -> float:
    """Peak memory of this process and its largest ended child; the kernel counts kilobytes, macOS bytes."""
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    usages = (resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usages) * unit / 2**20
