"""The pose graph of a run: created with it, and at its end trajectory and map corrected by it."""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lidarslam.config.settings import Config
from lidarslam.core.errors import ConfigError
from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.mapping.global_map.global_map import GlobalMap
from lidarslam.mapping.loops.closure import GivenLoops, RelativePose
from lidarslam.run.summary import GraphSummary, LoopReport, Milliseconds, ScanLog
from lidarslam.viewer.viewer import Viewer

if TYPE_CHECKING:  # GTSAM takes a while to load
    from lidarslam.mapping.global_map.georeference import ProjectedTrack
    from lidarslam.mapping.pose_graph.correction import Corrected
    from lidarslam.mapping.pose_graph.slam_graph import SlamGraph

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class GraphOutcome:
    """A run, or several connected ones, corrected by the graph."""

    T_world_lidar: FloatArray  # (M, 4, 4) corrected poses of all scans
    global_map: GlobalMap  # rebuilt
    # keyframe_poses, edges: (K, 4, 4) and the relative poses between them, for pose_graph.g2o
    keyframe_poses: FloatArray
    edges: tuple[RelativePose, ...]
    summary: GraphSummary


def begin_graph(
    config: Config,
    directory: Path | None = None,
    file: Path | None = None,
    takes_gnss: bool = False,
    given: GivenLoops | None = None,
) -> "SlamGraph | None":
    """The pose graph of a run, its submaps in a file of the directory or in the given one; None unless it is enabled.

    ConfigError where it is to use GNSS positions and the command takes none.
    """
    if config.pose_graph.gnss and not takes_gnss:
        raise ConfigError("pose_graph.gnss is available in lidarslam run only; leave it out here")
    if not config.pose_graph.enabled:
        return None
    from lidarslam.mapping.pose_graph.slam_graph import SlamGraph

    local_radius_m = config.mapping.radius_m if config.mapping.enabled else 0.0
    return SlamGraph(config.pose_graph, directory, file, local_radius_m, given)


def close_loops(
    graph: "SlamGraph | None",
    global_map: GlobalMap | None,
    log: ScanLog,
    viewer: Viewer,
    track: "ProjectedTrack | None" = None,
) -> GraphOutcome | None:
    """Correct the log, with a GNSS track if there is one, and show it; None where there is nothing to correct."""
    if graph is None or global_map is None:
        return None
    logger.info("optimising the pose graph")
    result = graph.finish() if track is None else _placed(graph, log, track)
    closed = correct(log, graph, result, global_map)
    loops = () if closed is None else closed.summary.loops
    log.warn(*_not_closed(graph, loops, len(log)))
    if closed is not None:
        pairs = [loop.scans for loop in loops if loop.accepted and loop.scans[1] < len(log)]
        viewer.show_closed(log.trajectory.positions, pairs)
    return closed


def _not_closed(graph: "SlamGraph", loops: Sequence[LoopReport], scans: int) -> Iterator[str]:
    """Why loop closures that were given are not in the graph."""
    tried = {loop.closure.given: loop for loop in loops}
    for first, second in graph.given.closed:
        loop = tried.get((first, second))
        if loop is None or not loop.accepted:
            untried = f"there are only {scans} scans" if second >= scans else "no keyframe lies between the scans"
            yield f"--loop {first} {second} was not closed: {untried if loop is None else loop.closure.reason}"


def _placed(graph: "SlamGraph", log: ScanLog, track: "ProjectedTrack") -> "Corrected | None":
    """The graph with a GNSS track, or without where that has too few positions."""
    from lidarslam.mapping.global_map.georeference import TooFewPositionsError  # loads SciPy

    try:
        return graph.finish((log.trajectory.stamps, track))
    except TooFewPositionsError as error:
        log.warn(f"without GNSS: {error}")
        return graph.present()


def correct(
    log: ScanLog, graph: "SlamGraph", result: "Corrected | None", global_map: GlobalMap
) -> "GraphOutcome | None":
    """Correct the log of one recording by its graph; None where that has nothing to correct it with."""
    if result is None:
        return None
    closed = FinishedGraph(graph, result, global_map.voxel_size_m, global_map.most_points).outcome([0])
    if closed is not None:
        log.correct(closed.T_world_lidar[: len(log)])
    return closed


@dataclass(frozen=True, eq=False)
class FinishedGraph:
    """An optimised graph of one recording or more; maps, with these voxels, are built on request."""

    graph: "SlamGraph"
    result: "Corrected"
    voxel_size_m: float
    most_points: int | None = None

    @property
    def joined(self) -> list[int]:
        """The recordings of the largest connected component, of several the first."""
        mapped = np.unique(self.result.keyframe_recordings)
        frames, counts = np.unique(self.result.frames[mapped], return_counts=True)
        return [int(recording) for recording in mapped[self.result.frames[mapped] == frames[counts.argmax()]]]

    def common(self) -> GraphOutcome | None:
        """The connected recordings, and why others are apart: the rejected loops between recordings."""
        joined = self.joined
        outcome = self.outcome(joined, numbered=True)
        apart = [
            loop
            for loop in self._loops(range(len(self.result.first_scans)), numbered=True)
            if not (loop.accepted or self._are_in(joined, loop.closure)) and len(set(loop.recordings or ())) > 1
        ]
        if outcome is None:
            return None
        return replace(outcome, summary=replace(outcome.summary, loops=(*outcome.summary.loops, *apart)))

    def outcome(self, recordings: Sequence[int], numbered: bool = False) -> GraphOutcome | None:
        """Some recordings, and the loops between them, on request with their numbers; None when none has a keyframe."""
        result = self.result
        chosen = np.flatnonzero(np.isin(result.keyframe_recordings, recordings))
        if not len(chosen):
            return None
        row = {int(key): new for new, key in enumerate(chosen)}
        edges = [edge for edge in result.edges if self._are_in(recordings, edge)]
        return GraphOutcome(
            T_world_lidar=np.concatenate([result.scan_poses(recording) for recording in recordings]),
            global_map=self.graph.draw_map(result, self.voxel_size_m, recordings, self.most_points),
            keyframe_poses=result.keyframe_poses[chosen],
            edges=tuple(replace(edge, first=row[edge.first], second=row[edge.second]) for edge in edges),
            summary=GraphSummary(
                keyframes=len(chosen),
                edges=len(edges),
                loops=self._loops(recordings, numbered or len(recordings) > 1),
                largest_correction_m=max(self._correction_m(recording) for recording in recordings),
                ms_per_keyframe=Milliseconds.of([self.graph.keyframe_ms[k] for k in chosen]),
            ),
        )

    def _correction_m(self, recording: int) -> float:
        """How far a recording's scans moved, its first keyframe held fixed."""
        keys = np.flatnonzero(self.result.keyframe_recordings == recording)
        if not len(keys):
            return 0.0
        begin, first = self.result.first_scans[recording], self.result.keyframe_scans[keys[0]]
        after = self.result.scan_poses(recording)
        before = np.array(self.graph.scan_poses[begin : begin + len(after)])
        T_common_own = self.result.T_world_lidar[first] @ inverse(self.graph.scan_poses[first])
        return float(np.linalg.norm(after[:, :3, 3] - (T_common_own @ before)[:, :3, 3], axis=1).max())

    def _are_in(self, recordings: Sequence[int], edge: RelativePose) -> bool:
        of = self.result.keyframe_recordings
        return bool(of[edge.first] in recordings and of[edge.second] in recordings)

    def _loops(self, recordings: Sequence[int], numbered: bool) -> tuple[LoopReport, ...]:
        of = self.result.keyframe_recordings
        scans = self.result.keyframe_scans - self.result.first_scans[of]
        return tuple(
            LoopReport(
                closure,
                inlier,
                (int(scans[closure.first]), int(scans[closure.second])),
                (int(of[closure.first]) + 1, int(of[closure.second]) + 1) if numbered else None,
            )
            for closure, inlier in zip(self.result.closures, self.result.inliers, strict=True)
            if self._are_in(recordings, closure)
        )
