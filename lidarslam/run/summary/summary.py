"""summary.json: a run in numbers, and its warnings."""

import resource
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from typing import Any

import numpy as np

from lidarslam.core.geometry import inverse
from lidarslam.core.text.plain_text import count
from lidarslam.core.tracking import Status
from lidarslam.mapping.slides.slides import Contradiction
from lidarslam.pipeline.estimates import STAGES
from lidarslam.run.elevation import Elevation, elevation_json
from lidarslam.run.loop_closing import GraphOutcome, LoopReport
from lidarslam.run.scan_log import ScanLog
from lidarslam.run.summary.time_scale import time_scale, time_scale_warning
from lidarslam.run.summary.timing import Milliseconds, SlowestScan
from lidarslam.run.summary.written_map import WrittenMap
from lidarslam.storage.directory import SCANS_CSV
from lidarslam.storage.summary_file import is_unconstrained

# An interval between scans is a gap when it exceeds the median by this many times and seconds.
_GAP_INTERVALS, _SHORTEST_GAP_S = 2.0, 0.3


@dataclass(frozen=True)
class LostStretch:
    """Successive lost scans: indices, stamps, and the message of the first."""

    first: int
    last: int
    first_stamp: float
    last_stamp: float
    reason: str


@dataclass(frozen=True)
class GraphSummary:
    """The pose graph of a run."""

    # keyframes, edges: how many
    keyframes: int
    edges: int
    loops: tuple[LoopReport, ...]  # accepted loop closures, and rejected candidates
    largest_correction_m: float  # by how much the graph moved a scan
    ms_per_keyframe: Milliseconds | None  # on the thread of the graph; None when there was no keyframe

    @classmethod
    def of(cls, closed: GraphOutcome) -> "GraphSummary":
        """Of an optimised graph."""
        return cls(
            keyframes=len(closed.keyframe_poses),
            edges=len(closed.edges),
            loops=closed.loops,
            largest_correction_m=closed.largest_correction_m,
            ms_per_keyframe=Milliseconds.of(closed.keyframe_ms) if closed.keyframe_ms else None,
        )

    @property
    def closed(self) -> int:
        """Number of accepted loop closures."""
        return sum(loop.accepted for loop in self.loops)

    def to_json(self) -> dict[str, Any]:
        """The section of summary.json."""
        return asdict(self) | {"loops": [loop.to_json() for loop in self.loops]}


@dataclass(frozen=True)
class RunSummary:
    """The content of summary.json.

    `ms_per_scan["total"]` is the time from one finished scan to the next, and `latency_ms` the sum of a scan's stages,
    which is more, as the stages of successive scans overlap.
    """

    scans: int
    length_m: float
    duration_s: float
    elapsed_s: float
    ms_per_scan: dict[str, Milliseconds]
    latency_ms: Milliseconds
    realtime_factor: float | None
    peak_rss_mb: float
    lost: tuple[LostStretch, ...]
    degraded_scans: int
    # way along axes of the sensor that the scans did not, or hardly, constrain: it is a prediction
    unconstrained_m: float
    odometry_asked: int  # number of scans
    graph: GraphSummary | None
    map: WrittenMap
    warnings: tuple[str, ...]
    contradictions: tuple[Contradiction, ...] = ()
    slowest: SlowestScan | None = None
    elevation: Elevation | None = None

    @property
    def elapsed_ms_per_scan(self) -> float:
        """Elapsed time of all scans over their number."""
        return 1e3 * self.elapsed_s / max(1, self.scans)

    @property
    def went_astray(self) -> bool:
        """Whether a scan is lost, the map contradicts itself, or much of the way is a prediction."""
        return bool(self.lost_scans or self.contradictions or self.is_unconstrained)

    @property
    def is_unconstrained(self) -> bool:
        """Whether the length is uncertain for want of structure along the way."""
        return is_unconstrained(self.unconstrained_m, self.length_m)

    @property
    def lost_scans(self) -> int:
        """Number of lost scans."""
        return sum(stretch.last - stretch.first + 1 for stretch in self.lost)

    def to_json(self) -> dict[str, Any]:
        """The content of summary.json."""
        return {
            "scans": self.scans,
            "length_m": self.length_m,
            "duration_s": self.duration_s,
            "elapsed_s": self.elapsed_s,
            "elapsed_ms_per_scan": self.elapsed_ms_per_scan,
            "latency_ms": vars(self.latency_ms),
            "ms_per_scan": {stage: vars(ms) for stage, ms in self.ms_per_scan.items()},
            "slowest_scan": None if self.slowest is None else vars(self.slowest),
            "realtime_factor": self.realtime_factor,
            "peak_rss_mb": self.peak_rss_mb,
            "lost_scans": self.lost_scans,
            "lost": [vars(stretch) for stretch in self.lost],
            "degraded_scans": self.degraded_scans,
            "unconstrained_m": self.unconstrained_m,
            "odometry_asked": self.odometry_asked,
            "map_contradictions": [vars(found) for found in self.contradictions],
            **elevation_json(self.elevation),
            **graph_and_map_json(self.graph, self.map, self.warnings),
        }


def graph_and_map_json(graph: GraphSummary | None, written: WrittenMap, warnings: Sequence[str]) -> dict[str, Any]:
    """The keys of summary.json that runs and merges share."""
    return {
        "loop_closures": 0 if graph is None else graph.closed,
        "pose_graph": None if graph is None else graph.to_json(),
        **written.to_json(),
        "warnings": list(warnings),
    }


def summarise(
    log: ScanLog,
    written: WrittenMap,
    skipped: int,
    closed: GraphOutcome | None = None,
    contradictions: tuple[Contradiction, ...] = (),
    elevation: Elevation | None = None,
) -> RunSummary:
    """Summarise a run.

    Args:
        log: its scans.
        written: the map.
        skipped: scans that were asked for and are missing without a warning in the log.
        closed: the optimised pose graph, if there is one.
        contradictions: where the map contradicts itself.
        elevation: the error of the sensor's elevations.
    """
    trajectory, total_ms = log.trajectory, log.total_ms
    stages = {"total": total_ms} | dict(zip(STAGES, log.stage_ms.T, strict=True))
    elapsed_s, unconstrained_m = float(total_ms.sum()) / 1e3, _unconstrained_m(log)
    return RunSummary(
        scans=len(log),
        length_m=trajectory.length_m,
        duration_s=trajectory.duration_s,
        elapsed_s=elapsed_s,
        ms_per_scan={stage: Milliseconds.of(values) for stage, values in stages.items()},
        latency_ms=Milliseconds.of(log.stage_ms.sum(axis=1)),
        realtime_factor=trajectory.duration_s / elapsed_s if elapsed_s > 0.0 and len(log) > 1 else None,
        peak_rss_mb=peak_rss_mb(),
        lost=tuple(_lost_stretches(log)),
        degraded_scans=log.statuses.count(Status.DEGRADED),
        unconstrained_m=unconstrained_m,
        odometry_asked=log.odometry_asked,
        graph=None if closed is None else GraphSummary.of(closed),
        map=written,
        warnings=(*log.warnings, *_warnings(log, skipped, contradictions, unconstrained_m)),
        contradictions=contradictions,
        slowest=SlowestScan.of(log.stage_ms),
        elevation=elevation,
    )


def _lost_stretches(log: ScanLog) -> Iterator[LostStretch]:
    stamps = log.stamps.tolist()
    for status, group in groupby(enumerate(log.statuses), key=lambda item: item[1]):
        if status is Status.LOST:
            indices = [index for index, _ in group]
            first, last = indices[0], indices[-1]
            yield LostStretch(first, last, stamps[first], stamps[last], log.messages[first])


def _unconstrained_m(log: ScanLog) -> float:
    """The way along axes of translation that are named as degenerate directions of the scans that reached them."""
    poses = log.trajectory.T_world_lidar
    moved = (inverse(poses[:-1]) @ poses[1:])[:, :3, 3]
    open_axes = np.array([[axis in names.split() for axis in "xyz"] for names in log.degenerate[1:]]).reshape(-1, 3)
    return float(np.linalg.norm(moved * open_axes, axis=1).sum())


def _warnings(
    log: ScanLog, skipped: int, contradictions: Sequence[Contradiction], unconstrained_m: float
) -> Iterator[str]:
    if skipped:
        yield f"{count(skipped, 'scan')} of those asked for missing"
    steps = np.diff(log.stamps)
    usual_s = float(np.median(steps)) if len(steps) else 0.0
    gaps = np.flatnonzero(steps > usual_s + max(_GAP_INTERVALS * usual_s, _SHORTEST_GAP_S))
    if len(gaps):
        longest = int(gaps[np.argmax(steps[gaps])])
        yield (
            f"{count(len(gaps), 'gap')} in the stamps, where scans are missing or a clock was set; the longest:"
            f" {steps[longest]:.1f} s after scan {longest}"
        )
    if log.points_dropped:
        share = log.points_dropped / max(1, len(log))
        points = count(log.points_dropped, "invalid point")
        yield f"{points} dropped (NaN, at the origin or out of range), {share:.0f} per scan"
    if degraded := log.statuses.count(Status.DEGRADED):
        yield f"tracking was degraded on {count(degraded, 'scan')}; {SCANS_CSV} gives the reasons"
    length_m = log.trajectory.length_m
    if is_unconstrained(unconstrained_m, length_m):
        yield (
            f"{unconstrained_m:.1f} m of the way of {length_m:.1f} m lie along directions that hardly any surface"
            " constrains: the length is uncertain, as in an even corridor"
        )
    is_tracked = np.array([status is Status.OK for status in log.statuses])
    if (wrong := time_scale_warning(time_scale(log.trajectory, log.turn_rates, is_tracked))) is not None:
        yield wrong
    if contradictions:
        clearest = max(contradictions, key=lambda found: found.votes - found.votes_at_pose)
        more = f"; {len(contradictions) - 1} more such stretches" if len(contradictions) > 1 else ""
        direction = "ahead of" if clearest.shift_m > 0.0 else "behind"
        yield (
            f"the map contradicts itself between scans {clearest.first} and {clearest.last}: the scans fit one another"
            f" {abs(clearest.shift_m):.1f} m {direction} their poses, which indicates a slip of registration{more}"
        )


def peak_rss_mb() -> float:
    """Peak memory of this process and its largest ended child; the kernel counts kilobytes, macOS bytes."""
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    usages = (resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usages) * unit / 2**20
