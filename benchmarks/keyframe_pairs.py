"""Submaps around the keyframes of simulated laps and of recordings, and pairs of keyframes of one place."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from loop_closures import drifting, simulate
from mapping_accuracy import METHODS, Recorded, pipeline_results

from lidarslam.core.geometry import FloatArray, inverse, transform_points
from lidarslam.core.thinning import one_per_cell
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.registry import open_recording
from lidarslam.mapping.config import KeyframeConfig, LoopConfig
from lidarslam.mapping.global_map.global_map import GlobalMap, means_points, voxel_size_for
from lidarslam.mapping.loops.detection import KeyframeDatabase
from lidarslam.mapping.loops.refinement import DenseSubmap
from lidarslam.mapping.pose_graph.keyframe_graph import KeyframeSelector, drift_covariance
from lidarslam.pipeline.threads import in_order
from lidarslam.simulation.recorder import Simulation

_LAPS, _EVERY = 1.34, 3


@dataclass(frozen=True, eq=False)
class Keyframes:
    """Keyframes of a recording."""

    name: str
    database: KeyframeDatabase  # at the estimates
    submaps: list[FloatArray]  # (N, 3) each
    scans: list[FloatArray]  # (N, 3) each keyframe's own scan, compensated
    truth: FloatArray  # (K, 4, 4) T_world_lidar
    pairs: list[tuple[int, int]]  # the later keyframe revisits the place of the earlier
    global_map: GlobalMap  # of all scans at the reference
    simulation: Simulation | None  # None for a recording

    def true_pose(self, first: int, second: int) -> FloatArray:
        """`T_first_second` (4, 4)."""
        return np.asarray(inverse(self.truth[first]) @ self.truth[second])

    def before(self, index: int) -> list[int]:
        """Keyframes a loop's least way and more before one."""
        way_m, least_m = self.database.track.way_m, max(10.0, 3.0 * self.database.submaps[index].range_m)
        return np.flatnonzero(way_m < way_m[index] - least_m).tolist()

    def map_before(self, index: int) -> FloatArray:
        """Points (N, 3) of their submaps in the world, half a cell apart."""
        parts = [transform_points(self.truth[k], self.submaps[k]) for k in self.before(index)]
        points = np.concatenate(parts)
        return points[one_per_cell(points, 0.5 * self.database.submaps[index].cell_m)]

    def dense(self, index: int, cell_m: float, max_range_m: float) -> tuple[FloatArray, FloatArray]:
        """Points (N, 3) of a submap and its two neighbours, as refinement has them, and their drift (6, 6)."""
        track = self.database.track
        around = range(max(0, index - 1), min(len(self.submaps), index + 2))
        parts = [(track.between(index, k), self.submaps[k]) for k in around]
        away_m = max(abs(track.way_m[k] - track.way_m[index]) for k in around)
        return DenseSubmap.join(parts, max_range_m, cell_m).points, drift_covariance(float(away_m)) / 3.0


def simulated(world: str, most: int, seed: int) -> Keyframes:
    """A lap and a third with a VLP-16, at poses that drift."""
    lap = simulate(world, "car" if world == "street" else "handheld", "vlp-16", "upright", seed, _LAPS, _EVERY)
    estimates = drifting(lap.truth, lap.way_m, 1.0, seed)
    return _keyframes(lap.name, list(lap.points()), lap.truth, estimates, most, lap.simulation)


def recorded(path: Path, most: int) -> Keyframes:
    """A recording; its reference is the trajectory of `learned+map`."""
    scans = list(in_order(open_recording(path).scans()))
    nothing = Trajectory(np.array([scan.stamp for scan in scans]), np.tile(np.eye(4), (len(scans), 1, 1)))
    results = pipeline_results(Recorded(path.name, scans, nothing), METHODS["learned+map"])
    truth = np.array([result.T_world_lidar for result in results])
    return _keyframes(path.name, [result.points for result in results], truth, truth, most, None)


def _keyframes(
    name: str,
    points: Sequence[FloatArray],
    truth: FloatArray,
    estimates: FloatArray,
    most: int,
    simulation: Simulation | None,
) -> Keyframes:
    selector, voxel_m = KeyframeSelector(KeyframeConfig()), voxel_size_for(points[0])
    merged, growing, chosen = GlobalMap(voxel_m), list[GlobalMap](), list[int]()
    for index, scan in enumerate(points):
        thinned = scan[one_per_cell(scan, voxel_m)]
        if selector.is_due(estimates[index], thinned):
            selector.take(estimates[index], thinned)
            chosen.append(index)
            growing.append(GlobalMap(voxel_m))
        growing[-1].add(thinned, inverse(estimates[chosen[-1]]) @ estimates[index])
        merged.add(thinned, truth[index])
    steps_m = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)
    way_m = np.append(0.0, np.cumsum(steps_m))[chosen]
    database, submaps = KeyframeDatabase(LoopConfig()), [means_points(submap.means()) for submap in growing]
    for k, submap in enumerate(submaps):
        database.add(submap, float(way_m[k]), 0, estimates[chosen[: k + 1]])
    scans = [points[index] for index in chosen]
    found = Keyframes(name, database, submaps, scans, truth[chosen], [], merged, simulation)
    for k in range(len(chosen)):
        earlier = np.array(found.before(k), dtype=np.intp)
        if len(earlier):
            away_m = np.linalg.norm(found.truth[earlier, :3, 3] - found.truth[k, :3, 3], axis=1)
            if away_m.min() < 0.5 * database.submaps[k].range_m:
                found.pairs.append((int(earlier[away_m.argmin()]), k))
    found.pairs[:] = found.pairs[:: max(1, -(-len(found.pairs) // most))]
    return found
