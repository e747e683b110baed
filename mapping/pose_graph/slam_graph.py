"""Graph SLAM: keyframes, relative poses between them, loop closures, and the poses that fit all of these best.

Scans come with the poses that scan-to-map registration gave them. Some become keyframes; the points seen until the next
one are the submap of each. Consecutive keyframes are joined by edges of the trajectory and of the odometry, and
submaps that show the same place by loop closures. In the end the whole graph is optimised, the scans between keyframes
follow, and the map is drawn anew from the submaps.

Several recordings of one place may follow one another. Only loop closures join them; those that are connected end up
in one frame.
"""

import time
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.scan import PointAttributes
from lidarslam.core.state.stateful import TRANSFORM, Stateful
from lidarslam.mapping.config import PoseGraphConfig
from lidarslam.mapping.global_map.global_map import GlobalMap, VoxelMeans, means_points
from lidarslam.mapping.global_map.tile_store import TileStore
from lidarslam.mapping.loops.closure import CHI_SQUARED_99, LoopClosure, RelativePose
from lidarslam.mapping.loops.detection import LoopDetector
from lidarslam.mapping.loops.refinement import refine
from lidarslam.mapping.pose_graph.attitude import Attitude, measured_attitude
from lidarslam.mapping.pose_graph.correction import Corrected, corrected_recordings, in_frames, recordings_of
from lidarslam.mapping.pose_graph.edges import MotionSinceKeyframe, first_connected, squared_error, trajectory_edges
from lidarslam.mapping.pose_graph.graph_scan import GraphScan
from lidarslam.mapping.pose_graph.keyframes import Keyframe, KeyframeSelector
from lidarslam.mapping.pose_graph.laid_submaps import LaidSubmaps, connected_with_last
from lidarslam.mapping.pose_graph.neighbourhoods import REACH, Neighbourhoods
from lidarslam.mapping.pose_graph.optimizer import optimise, relax
from lidarslam.mapping.pose_graph.relaxing import RelaxSchedule
from lidarslam.mapping.pose_graph.restored import require_edges, require_rows, require_scans, require_submaps
from lidarslam.mapping.pose_graph.submap_store import SubmapStore
from lidarslam.mapping.surfels.surfel_map import SurfelMap


class SlamGraph(Stateful):
    """Follows a run, one scan after the other, or several runs, one after the other.

    Args:
        config: settings of keyframes and loops.
        directory: where submaps are kept meanwhile, in a file without a name; None: where temporary files are.
        file: where they are kept instead, for `restore`.
        local_radius_m: of the local map that scans were registered to; 0 without one.
    """

    scan_poses: list[Annotated[FloatArray, TRANSFORM]]  # as registered, each recording's in its own world
    keyframe_ms: list[float]  # wall time of each keyframe
    _selector: KeyframeSelector
    _store: SubmapStore
    _detector: LoopDetector
    _submap: GlobalMap | None  # of the last keyframe, in its frame
    _first_scans: list[int]
    _keyframes: list[Keyframe]
    _poses: list[Annotated[FloatArray, TRANSFORM]]  # of keyframes, as estimated now
    _edges: list[RelativePose]
    _attitudes: list[Attitude]  # of the first recording, whose world they are in
    _closures: list[LoopClosure]
    _relaxing: RelaxSchedule
    _unrefined: list[int]  # accepted closures, neighbours of whose later keyframe are still to come
    _laid: LaidSubmaps  # in the running local map
    _is_map_due: bool  # whether closures have been refined since the local map was compared with them
    _motion: MotionSinceKeyframe
    _path_m: float
    _segment: int

    def __init__(
        self,
        config: PoseGraphConfig,
        directory: Path | None = None,
        file: Path | None = None,
        local_radius_m: float = 0.0,
    ) -> None:
        self._config = config
        self._selector = KeyframeSelector(config.keyframes)
        self._detector = LoopDetector(config.loops, directory if file is None else file.parent)
        self._store = SubmapStore(directory, file)
        self._submap = None
        self.scan_poses, self.keyframe_ms, self._first_scans = [], [], [0]
        self._keyframes, self._poses, self._edges, self._closures = [], [], [], []
        self._unrefined, self._attitudes, self._relaxing = [], [], RelaxSchedule()
        self._laid, self._is_map_due = LaidSubmaps(local_radius_m), False
        self._motion, self._path_m, self._segment = MotionSinceKeyframe.none(), 0.0, 0

    def _after_restore(self) -> None:
        require_submaps(len(self._keyframes), len(self._poses), len(self._laid), len(self._store))
        require_scans(self._keyframes, self._first_scans, len(self.scan_poses))
        require_edges((*self._edges, *self._closures, *self._relaxing.waiting), self._attitudes, len(self._poses))
        require_rows(self._unrefined, len(self._closures))
        self._detector.rebuild(means_points(self._store[key]) for key in range(len(self._store)))

    def begin_recording(self) -> None:
        """The next scan is the first of another recording, whose world is unrelated."""
        self._close_submap()
        self._first_scans.append(len(self.scan_poses))
        self._selector = KeyframeSelector(self._config.keyframes)
        self._motion, self._path_m, self._segment = MotionSinceKeyframe.none(), 0.0, self._segment + 1

    def draw(
        self, points: FloatArray, T_world_lidar: FloatArray, voxel_size_m: float, known: PointAttributes | None = None
    ) -> None:
        """Add points (N, 3) of the latest scan, at its pose as registered, to the submap of the last keyframe."""
        if not self._is_submap_open:
            return
        if self._submap is None:
            self._submap = GlobalMap(voxel_size_m)
        self._submap.add(points, inverse(self.scan_poses[self._keyframes[-1].scan]) @ T_world_lidar, known)

    def add(self, scan: GraphScan) -> None:
        """Take the next scan; the points of the one before have been drawn by now."""
        if len(self.scan_poses) > self._first_scans[-1]:
            step_m = float(np.linalg.norm(scan.T_world_lidar[:3, 3] - self.scan_poses[-1][:3, 3]))
            self._motion = self._motion.then(scan, step_m)
            self._path_m += step_m
        self.scan_poses.append(scan.T_world_lidar)
        if scan.belongs_in_map and len(scan.points) and self._selector.is_due(scan.T_world_lidar, scan.points):
            started = time.perf_counter()
            self._selector.take(scan.T_world_lidar, scan.points)
            self._close_submap()
            self._begin_keyframe(scan)
            self.keyframe_ms.append(1e3 * (time.perf_counter() - started))
        self._attitudes += measured_attitude(scan, self._keyframes, self.scan_poses, self._first_scans)

    def redrawn_local_map(self, cell_m: float) -> SurfelMap | None:
        """The local map drawn anew without the latest scan, in the frame of registration, with cells of that edge.

        None unless loop closures refined since the last call show that submaps lie elsewhere in the local map, or are
        missing.
        """
        is_due, self._is_map_due = self._is_map_due, False
        if not is_due:
            return None
        certain = [one for one in self._accepted() if squared_error(one, self._poses) < CHI_SQUARED_99]
        members = connected_with_last(self._keyframes, certain, self._first_scans[-1])
        targets = self.scan_poses[self._keyframes[-1].scan] @ inverse(self._poses[-1]) @ np.array(self._poses)
        return self._laid.redrawn(targets, members, cell_m, self._means, scan=len(self.scan_poses) - 1)

    def finish(self) -> Corrected | None:
        """Optimise everything; None when there is no keyframe."""
        if not self._keyframes:
            return None
        self._close_submap()
        self._closures += self._detector.finish()
        self._refine_closures(until=len(self._keyframes))
        return self._corrected(self._closures)

    def present(self) -> Corrected | None:
        """Optimise what there is, and stay as it is; None when there is no keyframe.

        Candidates that wait for others to agree are left out, and so are those of the last keyframe.
        """
        if not self._keyframes:
            return None
        waiting = set(self._unrefined)
        return self._corrected([self._refined(c) if row in waiting else c for row, c in enumerate(self._closures)])

    def _corrected(self, closures: Sequence[LoopClosure]) -> Corrected:
        """All poses, optimised with these loop closures, of which rejected ones are only listed."""
        accepted = [closure for closure in closures if closure.accepted]
        optimised = optimise(np.array(self._poses), self._edges, accepted, self._attitudes)
        kept = iter(optimised.inliers.tolist())
        inliers = tuple(closure.accepted and next(kept) for closure in closures)
        loops = [closure for closure, inlier in zip(closures, inliers, strict=True) if inlier]
        scans, firsts = np.array([keyframe.scan for keyframe in self._keyframes]), np.array(self._first_scans)
        of = recordings_of(scans, firsts)
        frames = first_connected(len(firsts), [(int(of[loop.first]), int(of[loop.second])) for loop in loops])
        registered = np.array(self.scan_poses)
        poses = in_frames(optimised.poses, frames[of], registered[scans])
        corrected, edges = corrected_recordings(registered, firsts, scans, poses), (*self._edges, *loops)
        return Corrected(corrected, scans, poses, tuple(closures), inliers, edges, firsts, frames)

    def draw_map(
        self, result: Corrected, voxel_size_m: float, recordings: Collection[int] | None = None, most: int | None = None
    ) -> GlobalMap:
        """The submaps of some recordings, or of all, at their corrected poses, with `most` voxels in memory."""
        drawn = GlobalMap(voxel_size_m, most, TileStore(self._store.directory))
        for index, (pose, recording) in enumerate(zip(result.keyframe_poses, result.keyframe_recordings, strict=True)):
            if recordings is None or recording in recordings:
                drawn.add_means(self._means(index), pose)
        return drawn

    def _means(self, index: int) -> VoxelMeans:
        """The submap of a keyframe, be it the one that still grows."""
        if index < len(self._store):
            return self._store[index]
        return (self._submap or GlobalMap(1.0)).means()

    def close(self) -> None:
        """Give up the submaps on disk."""
        self._store.close()

    @property
    def _is_submap_open(self) -> bool:
        """Whether the last keyframe's submap still grows."""
        return len(self._store) < len(self._keyframes)

    def _accepted(self) -> list[LoopClosure]:
        return [closure for closure in self._closures if closure.accepted]

    def _begin_keyframe(self, scan: GraphScan) -> None:
        motion, self._motion = self._motion, MotionSinceKeyframe.none()
        last = self._keyframes[-1] if self._keyframes else None
        if last is None or last.scan < self._first_scans[-1]:
            self._poses.append(scan.T_world_lidar)
        else:
            T_first_second = inverse(self.scan_poses[last.scan]) @ scan.T_world_lidar
            key = len(self._keyframes)
            one_map = not self._laid.is_exchanged(last.scan, len(self.scan_poses) - 1)
            self._edges += trajectory_edges(key, T_first_second, motion, last.covariance, scan.covariance, one_map)
            self._poses.append(self._poses[-1] @ T_first_second)
            self._segment += motion.lost  # the drift model does not hold across
        self._laid.follow(scan.T_world_lidar)
        self._keyframes.append(Keyframe(len(self.scan_poses) - 1, self._segment, self._path_m, scan.covariance))

    def _close_submap(self) -> None:
        """Keep the last keyframe's submap, and look for loop closures with it."""
        if not self._is_submap_open:
            return
        index, keyframe = len(self._keyframes) - 1, self._keyframes[-1]
        means, self._submap = self._means(index), None
        self._store.append(means)
        found = self._detector.add(means_points(means), keyframe.path_m, keyframe.segment, np.array(self._poses))
        self._unrefined += [len(self._closures) + i for i, closure in enumerate(found) if closure.accepted]
        self._closures += found
        refined = self._refine_closures(until=index - REACH)
        self._is_map_due = self._is_map_due or bool(refined)
        if self._relaxing.is_due([*found, *refined], self._poses):
            self._poses = list(relax(np.array(self._poses), self._edges, self._accepted(), self._attitudes))

    def _refine_closures(self, until: int) -> list[LoopClosure]:
        """Register accepted closures again whose later keyframe is not after `until`: its neighbours are all there."""
        rows = [row for row in self._unrefined if self._closures[row].second <= until]
        for row in rows:
            self._unrefined.remove(row)
            self._closures[row] = self._refined(self._closures[row])
        return [self._closures[row] for row in rows]

    def _refined(self, closure: LoopClosure) -> LoopClosure:
        """A closure registered on all points of both submaps and their neighbours."""
        cell_m = max(self._detector.cell_m(key) for key in (closure.first, closure.second))
        near, ends = Neighbourhoods(self._keyframes, self._poses, self._store), (closure.first, closure.second)
        target, source = (near.submap(key, self._config.loops.max_range_m, cell_m) for key in ends)
        closure = refine(target, source, closure, near.drift(closure.first) + near.drift(closure.second)) or closure
        first, second = self._keyframes[closure.first], self._keyframes[closure.second]
        if first.segment != second.segment:
            return closure
        return self._laid.measured(closure, first, second, self.scan_poses)
