"""Graph SLAM: keyframes, relative poses between them, loop closures, and the poses that fit all of these best.

Consecutive keyframes are joined by edges of the trajectory and of the odometry, submaps that show the same place by
loop closures. In the end the whole graph is optimised, the scans between keyframes follow, and the map is rebuilt from
the submaps. Recordings of one place are tracked each by itself, and added one after the other; loop closures join them.
"""

import logging
import time
from bisect import bisect_left
from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Annotated

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.state import TRANSFORM
from lidarslam.core.trajectory import Trajectory
from lidarslam.mapping.config import PoseGraphConfig
from lidarslam.mapping.global_map.georeference import ProjectedTrack
from lidarslam.mapping.global_map.global_map import GlobalMap, VoxelMeans, means_points
from lidarslam.mapping.global_map.voxels import TileStore
from lidarslam.mapping.loops.closure import CHI_SQUARED_99, GivenLoops, LoopClosure, RelativePose
from lidarslam.mapping.loops.detection import LoopDetector
from lidarslam.mapping.loops.verification import DenseSubmap, refine
from lidarslam.mapping.pose_graph.correction import Corrected, corrected_recordings, in_frames, recordings_of
from lidarslam.mapping.pose_graph.keyframe_graph import (
    GraphScan,
    Keyframe,
    KeyframeGraph,
    drift_covariance,
    first_connected,
    squared_error,
)
from lidarslam.mapping.pose_graph.optimizer import Optimised, RelaxSchedule, optimise, relax
from lidarslam.mapping.pose_graph.submap_placement import SubmapPlacement, connected_with_last
from lidarslam.mapping.registration.sampled_scan import CellSizes
from lidarslam.mapping.surfels.surfel_map import SurfelMap

logger = logging.getLogger(__name__)

# Submaps on either side: one alone is as sparse as the sensor, and over a longer path drift bends them.
REACH = 1


class SlamGraph(KeyframeGraph):
    """Follows a run, one scan after the other; or takes whole recordings, one after the other.

    The radius is that of the local map that scans were registered to, 0 without one. Loop closures may be given or
    forbidden, where one recording is followed.
    """

    _detector: LoopDetector
    _first_scans: list[int]  # of recordings that were added; none where one is followed
    _poses: list[Annotated[FloatArray, TRANSFORM]]  # of keyframes, as estimated now
    _closures: list[LoopClosure]
    _relaxing: RelaxSchedule
    _unrefined: list[int]  # accepted closures, neighbours of whose later keyframe are still to come
    _laid: SubmapPlacement  # in the running local map
    _is_map_due: bool  # whether closures have been refined since the local map was compared with them

    def __init__(
        self, config: PoseGraphConfig, directory: Path | None = None, file: Path | None = None,
        local_radius_m: float = 0.0, given: GivenLoops | None = None,
    ) -> None:  # fmt: skip
        super().__init__(config.keyframes, directory, file)
        self._config, self.given = config, given or GivenLoops()
        self._detector = LoopDetector(config.loops, directory if file is None else file.parent)
        self._first_scans, self._poses, self._closures, self._unrefined = [], [], [], []
        self._relaxing = RelaxSchedule()
        self._laid, self._is_map_due = SubmapPlacement(local_radius_m), False

    def _after_restore(self) -> None:
        for key in range(len(self.store)):
            self._detector.database.keep(means_points(self.store[key]))

    def add_recording(self, tracked: KeyframeGraph) -> None:
        """Add all keyframes of a recording that has ended, in a world of its own; look for loop closures with each."""
        first_scan, first_key = len(self.scan_poses), len(self.keyframes)
        first_segment = self.keyframes[-1].segment + 1 if self.keyframes else 0
        # The world of the first recording is that of the graph, which attitudes are in.
        known = [] if self._first_scans else tracked.attitudes
        attitudes = {key: list(group) for key, group in groupby(known, attrgetter("key"))}
        edges = {key: list(group) for key, group in groupby(tracked.edges, attrgetter("second"))}
        self._first_scans.append(first_scan)
        self.scan_poses += tracked.scan_poses
        self.redraws += [first_key + count for count in tracked.redraws]
        for key, keyframe in enumerate(tracked.keyframes):
            started = time.perf_counter()
            self._chain(tracked.scan_poses, tracked.keyframes[max(0, key - 1) : key + 1])
            self.edges += [replace(e, first=first_key + e.first, second=first_key + key) for e in edges.get(key, [])]
            self.keyframes.append(
                replace(keyframe, scan=first_scan + keyframe.scan, segment=first_segment + keyframe.segment)
            )
            self.attitudes += attitudes.get(key, [])
            self._keep(tracked.means(key))
            self.keyframe_ms.append(tracked.keyframe_ms[key] + 1e3 * (time.perf_counter() - started))

    def redrawn_local_map(self, cells_m: CellSizes) -> SurfelMap | None:
        """The local map rebuilt without the latest scan, in the frame of registration, with cells of those sizes.

        None unless closures refined since the last call show that submaps lie elsewhere in it, or are missing.
        """
        is_due, self._is_map_due = self._is_map_due, False
        if not is_due:
            return None
        certain = [c for c in self._closures if c.accepted and squared_error(c, self._poses) < CHI_SQUARED_99]
        members = connected_with_last(self.keyframes, certain)
        targets = self.scan_poses[self.keyframes[-1].scan] @ inverse(self._poses[-1]) @ np.array(self._poses)
        drawn = self._laid.redrawn(targets, members, cells_m, self.means, scan=len(self.scan_poses) - 1)
        self.redraws += [] if drawn is None else [len(self.keyframes)]
        return drawn

    def finish(self, placed: tuple[FloatArray, ProjectedTrack] | None = None) -> Corrected | None:
        """Optimise everything, with the stamps (M,) of the first scans and a GNSS track; None without a keyframe.

        A TooFewPositionsError is raised where too few positions are within the time of the scans.
        """
        if not self.keyframes:
            return None
        self.end_recording()
        self._closures += self._detector.finish()
        self._take(self._close_given(self.keyframes[-1].scan, len(self.scan_poses) - 1))
        self._refine_closures(until=len(self.keyframes))
        return self._corrected(self._closures, placed)

    def present(self) -> Corrected | None:
        """Optimise the graph so far, and leave it as it is, without pending candidates; None without a keyframe."""
        if not self.keyframes:
            return None
        waiting = set(self._unrefined)
        return self._corrected([self._refined(c) if row in waiting else c for row, c in enumerate(self._closures)])

    def _corrected(
        self, closures: Sequence[LoopClosure], placed: tuple[FloatArray, ProjectedTrack] | None = None
    ) -> Corrected:
        """All poses, optimised with these loop closures, of which rejected ones are only listed."""
        edges, uncertain = self._constraints(closures)
        optimised = optimise(np.array(self._poses), edges, uncertain, self.attitudes)
        if placed is not None:
            optimised = self._placed(optimised.poses, edges, uncertain, *placed)
        kept = iter(optimised.inliers.tolist())
        inliers = tuple(closure.accepted and (closure.given is not None or next(kept)) for closure in closures)
        loops = [closure for closure, inlier in zip(closures, inliers, strict=True) if inlier]
        scans, firsts = np.array([keyframe.scan for keyframe in self.keyframes]), np.array(self._first_scans or [0])
        of = recordings_of(scans, firsts)
        frames = first_connected(len(firsts), [(int(of[loop.first]), int(of[loop.second])) for loop in loops])
        registered = np.array(self.scan_poses)
        # An outlier closure may have moved a component that no edge moves back.
        poses = in_frames(optimised.poses, frames[of], registered[scans])
        corrected, measured = corrected_recordings(registered, firsts, scans, poses), (*self.edges, *loops)
        return Corrected(corrected, scans, poses, tuple(closures), inliers, measured, firsts, frames)

    def draw_map(
        self, result: Corrected, voxel_size_m: float, recordings: Collection[int] | None = None, most: int | None = None
    ) -> GlobalMap:
        """The submaps of some recordings, or of all, at their corrected poses, with `most` voxels in memory."""
        drawn = GlobalMap(voxel_size_m, most, TileStore(self.store.directory))
        for index, (pose, recording) in enumerate(zip(result.keyframe_poses, result.keyframe_recordings, strict=True)):
            if recordings is None or recording in recordings:
                drawn.add_means(self.means(index), pose)
        return drawn

    def _placed(
        self, poses: FloatArray, edges: Sequence[RelativePose], loops: Sequence[LoopClosure], stamps: FloatArray,
        track: ProjectedTrack,
    ) -> Optimised:  # fmt: skip
        """Optimise the keyframes' poses (K, 4, 4) in the projection, with GNSS positions; the result is of the run."""
        # An interrupted run knows the stamps of fewer scans than the graph was given.
        scans = np.array([one.scan for one in self.keyframes if one.scan < len(stamps)], dtype=np.intp)
        registered = Trajectory(stamps, np.array(self.scan_poses[: len(stamps)]))
        T_world_lidar = corrected_recordings(registered.T_world_lidar, np.array([0]), scans, poses[: len(scans)])
        T_map_world = track.aligned(Trajectory(stamps, T_world_lidar))
        attitudes = [replace(attitude, world=np.array([0.0, 0.0, 1.0])) for attitude in self.attitudes]
        positions = track.positions(registered, scans.tolist())
        optimised = optimise(T_map_world @ poses, edges, loops, attitudes, positions)
        T_world_map = poses[0] @ inverse(optimised.poses[0])
        logger.info("GNSS: %d of %d positions are inliers", optimised.position_inliers.sum(), len(positions))
        return replace(optimised, poses=T_world_map @ optimised.poses)

    def _constraints(self, closures: Sequence[LoopClosure]) -> tuple[list[RelativePose], list[LoopClosure]]:
        """Constraints that are never outliers, the edges and given closures, and closures that may be outliers."""
        accepted = [closure for closure in closures if closure.accepted]
        given = [closure for closure in accepted if closure.given is not None]
        return [*self.edges, *given], [closure for closure in accepted if closure.given is None]

    def _close_given(self, after: int, until: int) -> list[LoopClosure]:
        """The given closures whose later scan is in a range, between the first keyframes from their scans on."""
        scans = [keyframe.scan for keyframe in self.keyframes]
        found = []
        for pair in self.given.closed:
            first, second = (min(bisect_left(scans, scan), len(scans) - 1) for scan in pair)
            if after < pair[1] <= until and first < second:
                found.append(self._detector.close(first, second, pair))
        return found

    def _take(self, found: Sequence[LoopClosure]) -> None:
        self._unrefined += [len(self._closures) + i for i, closure in enumerate(found) if closure.accepted]
        self._closures += found

    def _begin_keyframe(self, scan: GraphScan, one_map: bool = True) -> None:
        last = self.keyframes[-1].scan if self.keyframes else 0
        super()._begin_keyframe(scan, one_map and not self._laid.is_exchanged(last, len(self.scan_poses) - 1))
        self._chain(self.scan_poses, self.keyframes[-2:])
        self._laid.follow(scan.T_world_lidar)

    def _chain(self, scan_poses: Sequence[FloatArray], latest: Sequence[Keyframe]) -> None:
        """Add the pose of the last of the latest keyframes, from the one before it in its recording."""
        pose = scan_poses[latest[-1].scan]
        if len(latest) > 1:
            pose = self._poses[-1] @ (inverse(scan_poses[latest[0].scan]) @ pose)
        self._poses.append(pose)

    def _keep(self, means: VoxelMeans) -> None:
        """Keep the submap of the last keyframe, and look for loop closures with it."""
        super()._keep(means)
        index, keyframe = len(self.keyframes) - 1, self.keyframes[-1]
        barred = self.given.barred(np.array([one.scan for one in self.keyframes]))
        track = keyframe.path_m, keyframe.segment, np.array(self._poses)
        found = self._detector.add(means_points(means), *track, barred)
        found += self._close_given(self.keyframes[-2].scan if index else -1, keyframe.scan)
        self._take(found)
        refined = self._refine_closures(until=index - REACH)
        self._is_map_due = self._is_map_due or bool(refined)
        if self._relaxing.is_due([*found, *refined], self._poses):
            self._poses = list(relax(np.array(self._poses), *self._constraints(self._closures), self.attitudes))

    def _refine_closures(self, until: int) -> list[LoopClosure]:
        """Register accepted closures again whose later keyframe is not after `until`: its neighbours are all there."""
        rows = [row for row in self._unrefined if self._closures[row].second <= until]
        self._unrefined = [row for row in self._unrefined if row not in rows]
        for row in rows:
            self._closures[row] = self._refined(self._closures[row])
        return [self._closures[row] for row in rows]

    def _refined(self, closure: LoopClosure) -> LoopClosure:
        """A closure registered on all points of both submaps and their neighbours, or as registration measured it."""
        ends = closure.first, closure.second
        cell_m = max(self._detector.database.submaps[key].cell_m for key in ends)
        target, source = (self._dense_submap(key, cell_m) for key in ends)
        closure = refine(target, source, closure, self._bend(closure.first) + self._bend(closure.second)) or closure
        first, second = self.keyframes[closure.first], self.keyframes[closure.second]
        # Of a recording that was added, the places of submaps in its rebuilt local maps are unknown.
        is_unknown = self._first_scans and any(closure.first < count <= closure.second for count in self.redraws)
        if first.segment != second.segment or is_unknown:
            return closure
        return self._laid.as_registered(closure, first, second, self.scan_poses)

    def _dense_submap(self, key: int, cell_m: float) -> DenseSubmap:
        """A keyframe's submap united with its neighbours'."""
        T_keyframe_world = inverse(self._poses[key])
        submaps = [(T_keyframe_world @ self._poses[k], means_points(self.store[k])) for k in self._around(key)]
        return DenseSubmap.join(submaps, self._config.loops.max_range_m, cell_m)

    def _bend(self, key: int) -> FloatArray:
        """(6, 6) drift of a keyframe's neighbours relative to it; each axis has a third of the squared error."""
        path_m = self.keyframes[key].path_m
        return drift_covariance(max(abs(self.keyframes[k].path_m - path_m) for k in self._around(key))) / 3.0

    def _around(self, key: int) -> list[int]:
        """A keyframe with its neighbours in its segment that have submaps by now."""
        near = range(max(0, key - REACH), min(len(self.store), key + REACH + 1))
        return [k for k in near if self.keyframes[k].segment == self.keyframes[key].segment]
