"""What a run does with its pose graph: begin it, and in the end correct trajectory and map by it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lidarslam.config.settings import Config
from lidarslam.core.geometry import FloatArray, inverse, rotation_angle
from lidarslam.core.state import Saved
from lidarslam.run.scan_log import ScanLog
from lidarslam.viewer.viewer import Viewer
from mapping.global_map.global_map import GlobalMap
from mapping.pose_graph.g2o import GraphFile

if TYPE_CHECKING:  # GTSAM takes a while to load
    from mapping.loops.detection import LoopClosure
    from mapping.pose_graph.slam_graph import Corrected, SlamGraph


@dataclass(frozen=True)
class LoopReport:
    """One place seen twice, or nearly believed to be; for the summary.

    Attributes:
        first_scan, second_scan: which scans of their recordings, the second the later one.
        accepted, reason: whether it is in the graph; why not.
        rest: overlap, residual and so on.
        first_recording, second_recording: which recordings, from 1; None where there is one only.
    """

    first_scan: int
    second_scan: int
    accepted: bool
    reason: str
    found_by: str
    overlap: float
    residual_m: float
    inlier_ratio: float
    consistent: int
    distance_m: float
    turn_deg: float
    first_recording: int | None = None
    second_recording: int | None = None

    def to_json(self) -> dict[str, Any]:
        """An entry of summary.json."""
        known = {name: value for name, value in vars(self).items() if value is not None}
        return {name: round(value, 4) if isinstance(value, float) else value for name, value in known.items()}


@dataclass(frozen=True, eq=False)
class GraphOutcome:
    """What a pose graph did to a run, or to several that it joined.

    Attributes:
        T_world_lidar: (M, 4, 4) corrected poses of all scans.
        global_map: drawn anew.
        graph: for pose_graph.g2o.
        loops: accepted ones, and those that were looked at closely and refused.
        largest_correction_m: by how much a scan moved; being moved into the frame of another run does not count.
        keyframe_ms: wall time of each keyframe, on a thread of its own.
    """

    T_world_lidar: FloatArray
    global_map: GlobalMap
    graph: GraphFile
    loops: tuple[LoopReport, ...]
    largest_correction_m: float
    keyframe_ms: tuple[float, ...]

    @property
    def accepted(self) -> tuple[LoopReport, ...]:
        """The loops that were closed."""
        return tuple(loop for loop in self.loops if loop.accepted)


def begin_graph(config: Config, directory: Path | None = None, file: Path | None = None) -> "SlamGraph | None":
    """A pose graph, when the configuration asks for one; what it puts aside lies in the directory, or in the file."""
    if not config.pose_graph.enabled:
        return None
    from mapping.pose_graph.slam_graph import SlamGraph

    return SlamGraph(config.pose_graph, directory, file, _local_radius_m(config))


def restore_graph(config: Config, saved: Saved, file: Path) -> "SlamGraph":
    """A pose graph with a state; what it put aside lies in the file.

    Raises:
        InputError: one of them is damaged.
    """
    from mapping.pose_graph.slam_graph import SlamGraph

    return SlamGraph.restored(config.pose_graph, saved, file, _local_radius_m(config))


def finish_graph(graph: "SlamGraph", scans: int, voxel_size_m: float) -> GraphOutcome | None:
    """Close the loops of so many scans for good, and draw the map anew; None where no scan could be believed."""
    finished = finish_recordings(graph, [scans], voxel_size_m)
    return None if finished is None else finished.of([0])


def _local_radius_m(config: Config) -> float:
    return config.mapping.radius_m if config.mapping.enabled else 0.0


def close_loops(
    graph: "SlamGraph | None", global_map: GlobalMap | None, log: ScanLog, viewer: Viewer
) -> GraphOutcome | None:
    """Correct what was logged, and show it, once all scans are there; None where there is nothing to correct."""
    if graph is None or global_map is None:
        return None
    closed = finish_graph(graph, len(log), global_map.voxel_size_m)
    if closed is not None:
        log.correct(closed.T_world_lidar)
        pairs = [(loop.first_scan, loop.second_scan) for loop in closed.accepted if loop.second_scan < len(log)]
        viewer.show_closed(log.trajectory.positions, pairs)
    return closed


def finish_recordings(graph: "SlamGraph", scans: Sequence[int], voxel_size_m: float) -> "FinishedGraph | None":
    """Close the loops within and between recordings of so many scans each; None where no scan could be believed."""
    result = graph.finish()
    return None if result is None else FinishedGraph(graph, result, tuple(scans), voxel_size_m)


@dataclass(frozen=True, eq=False)
class FinishedGraph:
    """A graph of one recording or more, all loops decided upon; maps are drawn when they are asked for."""

    _graph: "SlamGraph"
    _result: "Corrected"
    _scans: tuple[int, ...]
    _voxel_size_m: float

    @property
    def joined(self) -> list[int]:
        """The recordings that most of them are in one frame with; of several such frames, those of the first."""
        mapped = np.unique(self._result.keyframe_recordings)
        mapped = mapped[np.array(self._scans)[mapped] > 0]
        if not len(mapped):
            return []
        frames, counts = np.unique(self._result.frames[mapped], return_counts=True)
        return [int(recording) for recording in mapped[self._result.frames[mapped] == frames[counts.argmax()]]]

    def common(self) -> GraphOutcome | None:
        """What became of the recordings that are joined; its refused loops tell why others are not."""
        joined = self.joined
        ours = {recording + 1 for recording in joined}
        loops = tuple(
            loop
            for loop in self._loops(range(len(self._scans)), numbered=True)
            if {loop.first_recording, loop.second_recording} <= ours
            or (loop.first_recording != loop.second_recording and not loop.accepted)
        )
        return self._outcome(joined, loops)

    def of(self, recordings: Sequence[int]) -> GraphOutcome | None:
        """What became of some recordings, and of the loops between them; None when none has a keyframe."""
        return self._outcome(recordings, self._loops(recordings, numbered=len(recordings) > 1))

    def _outcome(self, recordings: Sequence[int], loops: tuple[LoopReport, ...]) -> GraphOutcome | None:
        chosen = np.flatnonzero(np.isin(self._result.keyframe_recordings, recordings))
        if not len(chosen):
            return None
        poses = [self._scan_poses(recording) for recording in recordings]
        return GraphOutcome(
            T_world_lidar=np.concatenate(poses),
            global_map=self._graph.draw_map(self._result, self._voxel_size_m, recordings),
            graph=_part(self._result.graph, chosen),
            loops=loops,
            largest_correction_m=max(self._correction_m(recording) for recording in recordings),
            keyframe_ms=tuple(self._graph.keyframe_ms[k] for k in chosen),
        )

    def _scan_poses(self, recording: int) -> FloatArray:
        begin = self._result.first_scans[recording]
        return self._result.T_world_lidar[begin : begin + self._scans[recording]]

    def _correction_m(self, recording: int) -> float:
        """How far a recording's scans moved, its first keyframe held where it is."""
        keys = np.flatnonzero(self._result.keyframe_recordings == recording)
        if not len(keys) or not self._scans[recording]:
            return 0.0
        begin, first = self._result.first_scans[recording], self._result.keyframe_scans[keys[0]]
        before, after = (
            np.array(self._graph.scan_poses[begin : begin + self._scans[recording]]),
            self._scan_poses(recording),
        )
        T_common_own = self._result.T_world_lidar[first] @ inverse(self._graph.scan_poses[first])
        return float(np.linalg.norm(after[:, :3, 3] - (T_common_own @ before)[:, :3, 3], axis=1).max())

    def _loops(self, recordings: Sequence[int], numbered: bool) -> tuple[LoopReport, ...]:
        of, scans = self._result.keyframe_recordings, self._result.keyframe_scans - self._first_of_keyframes
        found = []
        for closure, believed in zip(self._result.closures, self._result.believed, strict=True):
            first, second = int(of[closure.first]), int(of[closure.second])
            if first in recordings and second in recordings:
                ends = (int(scans[closure.first]), int(scans[closure.second]))
                found.append(_report(closure, believed, ends, (first + 1, second + 1) if numbered else (None, None)))
        return tuple(found)

    @property
    def _first_of_keyframes(self) -> NDArray[np.intp]:
        """(K,) the first scan of each keyframe's recording."""
        return self._result.first_scans[self._result.keyframe_recordings]


def _part(graph: GraphFile, keys: NDArray[np.intp]) -> GraphFile:
    """Some of the poses of a graph whose keys count up from 0, counted anew, and the edges between them."""
    new = np.full(len(graph.keys), -1)
    new[keys] = np.arange(len(keys))
    edges = [
        replace(edge, first=int(new[edge.first]), second=int(new[edge.second]))
        for edge in graph.edges
        if new[edge.first] >= 0 and new[edge.second] >= 0
    ]
    return GraphFile(np.arange(len(keys)), graph.poses[keys], tuple(edges))


def _report(
    closure: "LoopClosure", believed: bool, scans: tuple[int, int], recordings: tuple[int | None, int | None]
) -> LoopReport:
    outvoted = closure.verdict == "accepted" and not believed
    T = closure.T_first_second
    return LoopReport(
        first_scan=scans[0],
        second_scan=scans[1],
        accepted=believed,
        reason="does not fit the other edges of the graph" if outvoted else closure.reason,
        found_by=closure.found_by,
        overlap=closure.overlap,
        residual_m=closure.residual_m,
        inlier_ratio=closure.inlier_ratio,
        consistent=closure.consistent,
        distance_m=float(np.linalg.norm(T[:3, 3])),
        turn_deg=float(np.rad2deg(rotation_angle(T))),
        first_recording=recordings[0],
        second_recording=recordings[1],
    )
