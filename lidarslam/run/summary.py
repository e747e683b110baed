"""The log of a run, a row a scan, for scans.csv; the run in numbers, and what is wrong with it, for summary.json."""

import csv
import io
import resource
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, inverse, rotation_angle
from lidarslam.core.state import State, Stateful
from lidarslam.core.text import count
from lidarslam.core.tracking import AXES, Status
from lidarslam.core.trajectory import Trajectory, lengthened_by_noise_m
from lidarslam.mapping.consistency import Contradiction
from lidarslam.mapping.global_map.global_map import TiledMap
from lidarslam.mapping.loops.closure import LoopClosure
from lidarslam.pipeline.estimates import STAGES, ScanEstimate
from lidarslam.run.calibration import Elevation, time_scale, time_scale_warning
from lidarslam.storage.directory import SCANS_CSV, SIGMAS
from lidarslam.storage.finished_run import is_unconstrained, seen_through, too_many_unreadable, where_astray

COLUMNS = (
    *("index", "stamp", "status", "points", "points_dropped", "points_used", "residual_m", "inlier_ratio"),
    *("degenerate_directions", *SIGMAS, "odometry_asked", *(f"ms_{stage}" for stage in STAGES), "message"),
)

_STATUSES = tuple(Status)
# The numbers of a scan; NaN where there is none.
_ROW = np.dtype(
    [
        ("stamp", "f8"),
        ("status", "u1"),
        *((name, "i8") for name in ("points", "points_dropped", "points_used")),
        *((name, "f8") for name in ("residual_m", "inlier_ratio")),
        ("sigmas", "f8", len(SIGMAS)),
        ("turn_rate", "f8", 3),
        ("odometry_asked", "?"),
        ("total_ms", "f8"),  # from the scan before done to this one done
        ("stage_ms", "f8", len(STAGES)),
        ("T_world_lidar", "f8", (4, 4)),
        ("T_odom_lidar", "f8", (4, 4)),
    ]
)


class ScanLog(Stateful):
    """The scans of a run so far; no points."""

    messages: list[str]  # of each scan
    warnings: list[str]  # sentences for the summary
    degenerate: list[str]  # of each scan, the names of its degenerate directions with spaces between

    def __init__(self) -> None:
        self.messages, self.warnings, self.degenerate = [], [], []
        self._rows = bytearray()  # of `_ROW`

    def __len__(self) -> int:
        return len(self._rows) // _ROW.itemsize

    def add(self, result: ScanEstimate, total_ms: float = 0.0) -> None:
        """Log one scan; `total_ms` is the wall time since the previous scan was done."""
        row = (
            result.stamp,
            _STATUSES.index(result.status),
            result.points_read,
            result.points_dropped,
            result.points_used,
            np.nan if result.residual_m is None else result.residual_m,
            np.nan if result.inlier_ratio is None else result.inlier_ratio,
            np.full(len(SIGMAS), np.nan) if result.covariance is None else np.sqrt(np.diag(result.covariance)),
            np.full(3, np.nan) if result.turn_rate is None else result.turn_rate,
            result.is_odometry_asked,
            total_ms,
            [result.stage_ms.get(stage, 0.0) for stage in STAGES],
            result.T_world_lidar,
            result.T_odom_lidar,
        )
        self.degenerate.append(" ".join(result.degenerate))
        self.messages.append(result.message)
        self._rows += np.array(row, dtype=_ROW).tobytes()  # last, as Ctrl-C may interrupt: `len` counts rows

    def warn(self, *sentences: str | None) -> None:
        """Keep sentences for the summary, each once."""
        for sentence in sentences:
            if sentence is not None and sentence not in self.warnings:
                self.warnings.append(sentence)

    def correct(self, T_world_lidar: FloatArray) -> None:
        """Replace the poses (N, 4, 4) by those that the pose graph corrected."""
        rows = self.table
        rows["T_world_lidar"] = T_world_lidar
        self._rows = bytearray(rows.tobytes())

    def mark(self, indices: Sequence[int], status: Status, message: str) -> None:
        """Replace the status of scans, and its reason."""
        rows = self.table
        rows["status"][list(indices)] = _STATUSES.index(status)
        self._rows = bytearray(rows.tobytes())
        for index in indices:
            self.messages[index] = message

    @property
    def table(self) -> NDArray[np.void]:
        """(N,) the numbers of all scans, by the names of `_ROW`; a copy, as a view would keep the log from growing."""
        return np.frombuffer(bytearray(self._rows), _ROW)

    @property
    def statuses(self) -> list[Status]:
        """Of each scan."""
        return [_STATUSES[index] for index in self.table["status"]]

    @property
    def stamps(self) -> FloatArray:
        """(N,) seconds."""
        return self.table["stamp"]

    @property
    def trajectory(self) -> Trajectory:
        """The final poses."""
        return Trajectory(self.stamps, self.table["T_world_lidar"])

    @property
    def odometry(self) -> Trajectory:
        """The poses of the odometry alone."""
        return Trajectory(self.stamps, self.table["T_odom_lidar"])

    def format_csv(self) -> str:
        """The content of scans.csv: a row per scan, empty where there is no number."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(COLUMNS)
        rows = zip(self.table, self.degenerate, self.messages, strict=False)
        for index, (row, degenerate, message) in enumerate(rows):
            counts = (row["points"], row["points_dropped"], row["points_used"])
            fit = ("" if np.isnan(row[name]) else f"{row[name]:.4f}" for name in ("residual_m", "inlier_ratio"))
            sigmas = ("" if np.isnan(sigma) else f"{sigma:.3g}" for sigma in row["sigmas"])
            ms = (f"{ms:.2f}" for ms in row["stage_ms"])
            status, asked = _STATUSES[row["status"]].value, int(row["odometry_asked"])
            numbers = (*counts, *fit, degenerate, *sigmas, asked, *ms)
            writer.writerow([index, f"{row['stamp']:.9f}", status, *numbers, message])
        return out.getvalue()

    def state(self) -> State:
        return super().state() | {"rows": self.table}

    def restore(self, saved: State) -> None:
        super().restore(saved)
        self._rows = bytearray(saved["rows"].tobytes())


@dataclass(frozen=True)
class Milliseconds:
    """Median, 95th and 99th percentile of wall times."""

    median: float
    p95: float
    p99: float

    @classmethod
    def of(cls, values: Sequence[float] | FloatArray) -> "Milliseconds":
        """Of at least one time."""
        return cls(*np.percentile(values, [50.0, 95.0, 99.0]).tolist())


@dataclass(frozen=True)
class SlowestScan:
    """The longest stage of any scan but the first, which waits for loops to be loaded."""

    scan: int
    stage: str
    ms: float

    @classmethod
    def of(cls, stage_ms: FloatArray) -> "SlowestScan | None":
        """By the times (N, S) of the `STAGES`; None of fewer than two scans."""
        if len(stage_ms) < 2:
            return None
        scan, stage = divmod(int(stage_ms[1:].argmax()), stage_ms.shape[1])
        return cls(scan + 1, STAGES[stage], float(stage_ms[scan + 1, stage]))


@dataclass(frozen=True)
class WrittenMap:
    """The map as it was written."""

    # points, voxel_size_m: number of points and edge of a voxel; None without a map
    points: int
    voxel_size_m: float | None
    moved: int  # number of points that were removed as moving objects
    entropy: float | None = None  # mean map entropy, see `evaluation.map.entropy`; None where it cannot be computed
    fields: tuple[str, ...] = ()  # the attributes of its points
    tiled: TiledMap | None = None  # all of it, where `points` are those of an overview

    def to_json(self) -> dict[str, Any]:
        """Its keys of summary.json."""
        named = {f"map_{name}": getattr(self, name) for name in ("points", "voxel_size_m", "entropy")}
        tiles = None if self.tiled is None else self.tiled.to_json()
        return named | {"map_points_moved": self.moved, "map_fields": list(self.fields), "map_tiles": tiles}


@dataclass(frozen=True)
class LostStretch:
    """Successive lost scans: indices, stamps, and the message of the first."""

    first: int
    last: int
    first_stamp: float
    last_stamp: float
    reason: str


@dataclass(frozen=True)
class LoopReport:
    """A loop closure in the summary."""

    closure: LoopClosure  # between keyframes
    accepted: bool  # whether it is in the graph: an outlier of the optimisation is not
    scans: tuple[int, int]  # indices in their recordings, the second the later one
    recordings: tuple[int, int] | None = None  # which, from 1; None where there is one only

    def to_json(self) -> dict[str, Any]:
        """An entry of summary.json."""
        closure, of, T = self.closure, self.recordings, self.closure.T_first_second
        outlier = closure.accepted and not self.accepted
        numbers = {
            "overlap": closure.overlap,
            "residual_m": closure.residual_m,
            "inlier_ratio": closure.inlier_ratio,
            "distance_m": float(np.linalg.norm(T[:3, 3])),
            "turn_deg": float(np.rad2deg(rotation_angle(T))),
        }
        return {
            "first_scan": self.scans[0],
            "second_scan": self.scans[1],
            "accepted": self.accepted,
            "reason": "does not fit the other edges of the graph" if outlier else closure.reason,
            "found_by": "given" if closure.given else "appearance" if closure.by_appearance else "nearby",
            "consistent": closure.consistent,
            **{name: round(number, 4) if np.isfinite(number) else None for name, number in numbers.items()},
            **({} if of is None else {"first_recording": of[0], "second_recording": of[1]}),
        }


@dataclass(frozen=True)
class GraphSummary:
    """The optimised pose graph of a run."""

    keyframes: int
    edges: int
    loops: tuple[LoopReport, ...]  # accepted loop closures, and rejected candidates
    largest_correction_m: float  # of a scan's position; a move into the frame of another run does not count
    ms_per_keyframe: Milliseconds  # on the thread of the graph

    @property
    def closed(self) -> int:
        """Number of accepted loop closures."""
        return sum(loop.accepted for loop in self.loops)

    def to_json(self) -> dict[str, Any]:
        """The section of summary.json."""
        return asdict(self) | {"loops": [loop.to_json() for loop in self.loops]}


@dataclass(frozen=True, kw_only=True)
class RunSummary:
    """The content of summary.json, in its order and by its keys, but for those of `graph_and_map_json`.

    `ms_per_scan["total"]` is the time from one finished scan to the next, and `latency_ms` the sum of a scan's stages,
    which is more, as the stages of successive scans overlap.
    """

    scans: int
    length_m: float
    duration_s: float
    elapsed_s: float
    elapsed_ms_per_scan: float  # elapsed time of all scans over their number
    realtime_factor: float | None
    peak_rss_mb: float
    lost_scans: int
    degraded_scans: int
    # distance travelled along axes of the sensor that the scans did not, or hardly, constrain: it is a prediction
    unconstrained_m: float
    odometry_asked: int  # number of scans
    unreadable_scans: int  # number of scans that were asked for and are damaged or missing
    latency_ms: Milliseconds
    ms_per_scan: dict[str, Milliseconds]
    slowest_scan: SlowestScan | None
    lost: tuple[LostStretch, ...]
    map_contradictions: tuple[Contradiction, ...]
    # as of `calibration.Elevation`
    elevation_bias_deg: float | None = None
    elevation_sigma_deg: float | None = None
    elevation_correction_deg: float | None = None
    # ratio of the turn rates within sweeps to those from scan to scan, as of `calibration.time_scale`
    time_scale: float | None
    graph: GraphSummary | None
    map: WrittenMap
    warnings: tuple[str, ...]

    @property
    def went_astray(self) -> bool:
        """Whether the exit status is 3."""
        return where_astray(self.to_json()) is not None

    def to_json(self) -> dict[str, Any]:
        """The content of summary.json."""
        own = {name: value for name, value in asdict(self).items() if name not in ("graph", "map", "warnings")}
        return own | graph_and_map_json(self.graph, self.map, self.warnings)


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
    unreadable: int,
    graph: GraphSummary | None = None,
    contradictions: tuple[Contradiction, ...] = (),
    elevation: Elevation | None = None,
) -> RunSummary:
    """Summarise a run, which lacks a number of unreadable scans."""
    trajectory, total_ms, stage_ms = log.trajectory, log.table["total_ms"], log.table["stage_ms"]
    stages = {"total": total_ms} | dict(zip(STAGES, stage_ms.T, strict=True))
    elapsed_s, unconstrained_m = float(total_ms.sum()) / 1e3, _unconstrained_m(log)
    is_tracked = np.array([status is Status.OK for status in log.statuses])
    scale = time_scale(trajectory, log.table["turn_rate"], is_tracked)
    return RunSummary(
        scans=len(log),
        length_m=trajectory.length_m,
        duration_s=trajectory.duration_s,
        elapsed_s=elapsed_s,
        elapsed_ms_per_scan=1e3 * elapsed_s / max(1, len(log)),
        realtime_factor=trajectory.duration_s / elapsed_s if elapsed_s > 0.0 and len(log) > 1 else None,
        peak_rss_mb=peak_rss_mb(),
        lost_scans=log.statuses.count(Status.LOST),
        degraded_scans=log.statuses.count(Status.DEGRADED),
        unconstrained_m=unconstrained_m,
        odometry_asked=int(log.table["odometry_asked"].sum()),
        unreadable_scans=unreadable,
        latency_ms=Milliseconds.of(stage_ms.sum(axis=1)),
        ms_per_scan={stage: Milliseconds.of(values) for stage, values in stages.items()},
        slowest_scan=SlowestScan.of(stage_ms),
        lost=tuple(_lost_stretches(log)),
        map_contradictions=contradictions,
        **({} if elevation is None else asdict(elevation)),
        time_scale=None if scale is None else scale[0],
        graph=graph,
        map=written,
        warnings=(*log.warnings, *_warnings(log, unreadable, contradictions, written, unconstrained_m, scale)),
    )


# An interval between scans is a gap when it exceeds the median by this many times and seconds.
_GAP_INTERVALS, _SHORTEST_GAP_S = 2.0, 0.3
_WALKING_MPS = 1.5
# Of a sensor that is not at rest.
_SHORTEST_MOTION_M = 0.02
# Of a vehicle, m/s^2.
_MOST_ACCELERATION = 4.0
# A motion that is faster than those before and after it by this many m/s is a jump from or to a wrong place.
_JUMP_MPS = 5.0


def _lost_stretches(log: ScanLog) -> Iterator[LostStretch]:
    stamps = log.stamps.tolist()
    for status, group in groupby(enumerate(log.statuses), key=lambda item: item[1]):
        if status is Status.LOST:
            indices = [index for index, _ in group]
            first, last = indices[0], indices[-1]
            yield LostStretch(first, last, stamps[first], stamps[last], log.messages[first])


def _unconstrained_m(log: ScanLog) -> float:
    """The distance travelled along axes of translation that are degenerate in the scans at the motions' ends.

    Where a rotation is degenerate, hardly anything is known of the motion; where all axes are, not even the speed. A
    motion that is shorter than the position's standard deviation along it may be noise.
    """
    poses = log.trajectory.T_world_lidar
    moved = (inverse(poses[:-1]) @ poses[1:])[:, :3, 3]
    open_of = [[axis in names.split() for axis in AXES] for names in log.degenerate[1:]]
    degenerate = np.array(open_of, dtype=bool).reshape(-1, 6)
    rotation, translation = np.hsplit(degenerate, 2)
    open_axes = translation | rotation.any(axis=1, keepdims=True)
    whole_m = np.linalg.norm(moved, axis=1)
    # The standard deviation along a motion, times its length; NaN, and no noise, without a covariance.
    scaled_m2 = np.linalg.norm(moved * log.table["sigmas"][1:, 3:], axis=1)
    is_noise = (whole_m > _SHORTEST_MOTION_M) & (whole_m**2 < scaled_m2)
    speeds = whole_m / np.diff(log.stamps)
    before, after = np.append(speeds[:1], speeds[:-1]), np.append(speeds[1:], speeds[-1:])
    is_jump = speeds > np.maximum(before, after) + _JUMP_MPS
    lengths_m = np.where(is_noise | is_jump, whole_m, np.linalg.norm(moved * open_axes, axis=1))
    lengths_m = np.maximum(lengths_m, lengthened_by_noise_m(log.trajectory.positions, log.table["sigmas"][:, 3:]))
    is_unknown = degenerate.all(axis=1)
    lengths_m[is_unknown] = np.maximum(lengths_m, _WALKING_MPS * np.diff(log.stamps))[is_unknown]
    lengths_m[:1] = np.maximum(lengths_m[:1], _unconfirmed_start_m(log))
    return float(lengths_m.sum())


def _unconfirmed_start_m(log: ScanLog) -> float:
    """The unconfirmed distance of the first motion, which has no earlier one to agree with.

    A degraded one lacks a walking speed: amid people who walk along, it appears to be none. One that the second
    contradicts counts in full: where they differ by half of it, and by more than a vehicle accelerates.
    """
    moved, intervals_s = np.diff(log.trajectory.positions[:3], axis=0), np.diff(log.stamps)[:2]
    if len(intervals_s) == 2 and (intervals_s > 0.0).all():
        first, second = moved / intervals_s[:, None]
        change = np.linalg.norm(second - first)
        if change > max(0.5 * np.linalg.norm(first), _MOST_ACCELERATION * intervals_s.mean()):
            return float(np.linalg.norm(moved[0]))
    if log.statuses[1:2] == [Status.DEGRADED]:
        return float(_WALKING_MPS * intervals_s[0] - np.linalg.norm(moved[0]))
    return 0.0


def _warnings(
    log: ScanLog, unreadable: int, contradictions: Sequence[Contradiction], written: WrittenMap, unconstrained_m: float,
    scale: tuple[float, int] | None,
) -> Iterator[str]:  # fmt: skip
    if (lacking := too_many_unreadable(unreadable, len(log))) is not None:
        yield f"{lacking}: the results lack a considerable part of the recording"
    steps = np.diff(log.stamps)
    usual_s = float(np.median(steps)) if len(steps) else 0.0
    gaps = np.flatnonzero(steps > usual_s + max(_GAP_INTERVALS * usual_s, _SHORTEST_GAP_S))
    if len(gaps):
        longest = int(gaps[np.argmax(steps[gaps])])
        yield (
            f"{count(len(gaps), 'gap')} in the stamps, where scans are missing or a clock was set; the longest:"
            f" {steps[longest]:.1f} s after scan {longest}"
        )
    if dropped := int(log.table["points_dropped"].sum()):
        share = dropped / max(1, len(log))
        yield f"{count(dropped, 'invalid point')} dropped (NaN, at the origin or out of range), {share:.0f} per scan"
    if degraded := log.statuses.count(Status.DEGRADED):
        yield f"tracking was degraded on {count(degraded, 'scan')}; {SCANS_CSV} gives the reasons"
    length_m = log.trajectory.length_m
    if is_unconstrained(unconstrained_m, length_m):
        yield (
            f"the length of {length_m:.1f} m is uncertain by {unconstrained_m:.1f} m: hardly any surface constrains the"
            " motion there, as in a featureless corridor or with a sparse sensor, or people walk along"
        )
    if (wrong := time_scale_warning(scale)) is not None:
        yield wrong
    if contradictions:
        clearest = max(contradictions, key=lambda found: found.votes - found.votes_at_pose)
        more = f"; {len(contradictions) - 1} more such stretches" if len(contradictions) > 1 else ""
        direction = "ahead of" if clearest.shift_m > 0.0 else "behind"
        yield (
            f"the map contradicts itself between scans {clearest.first} and {clearest.last}: the scans fit one another"
            f" {abs(clearest.shift_m):.1f} m {direction} their poses, which indicates a slip of registration{more}"
        )
    if (through := seen_through(written.points, written.moved, length_m, log.trajectory.duration_s)) is not None:
        yield f"{through}, which indicates a slip of registration, as with much range noise, or many moving objects"


def peak_rss_mb() -> float:
    """Peak memory of this process and its largest ended child; the kernel counts kilobytes, macOS bytes."""
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    usages = (resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usages) * unit / 2**20
