"""Simultaneous localisation and mapping with memory: keyframes, loops among them, and what they do to all poses.

Scans come with the poses that scan-to-map refinement gave them. Some become keyframes; what is seen until the next is
the submap of each. Between keyframes the trajectory and the odometry are edges of the pose graph, and wherever a
submap turns out to show a place seen before, so is the closure. In the end all of it is optimised together, the scans
between keyframes follow, and the map is drawn anew from the submaps.
"""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, adjoint, inverse
from mapping.correction import corrected
from mapping.g2o import Edge, GraphFile
from mapping.global_map import GlobalMap
from mapping.graph_config import SlamGraphConfig, TrajectoryEdgeConfig
from mapping.graph_scan import GraphScan
from mapping.keyframe import KeyframeSelector
from mapping.loop_closure import LoopClosure, LoopDetector, Submap
from mapping.pose_graph import PoseGraph
from mapping.submap_store import SubmapStore


@dataclass(frozen=True, eq=False)
class Corrected:
    """What the graph came to.

    Attributes:
        T_world_lidar: (M, 4, 4) of all scans.
        keyframe_scans: (K,) which of them are keyframes.
        closures: all that were looked at closely, refused ones too; `believed` (same length) says which the optimiser
            kept in the end.
        graph: keyframes and edges, refused closures left out.
    """

    T_world_lidar: FloatArray
    keyframe_scans: NDArray[np.intp]
    closures: tuple[LoopClosure, ...]
    believed: tuple[bool, ...]
    graph: GraphFile


class _Way:
    """What happened since the last keyframe: the odometry's motion, how far it went, and whether tracking was lost."""

    def __init__(self) -> None:
        self.T_keyframe_lidar: FloatArray | None = np.eye(4)  # the odometry's; None once it failed
        self.covariance: FloatArray = np.zeros((6, 6))
        self.length_m = 0.0
        self.lost = False

    def go(self, scan: GraphScan, step_m: float) -> None:
        """One scan further."""
        self.length_m += step_m
        self.lost |= scan.lost
        if self.T_keyframe_lidar is None or scan.T_prev_curr is None or scan.motion_covariance is None:
            self.T_keyframe_lidar = None
            return
        self.T_keyframe_lidar = self.T_keyframe_lidar @ scan.T_prev_curr
        A = adjoint(inverse(scan.T_prev_curr))
        self.covariance = A @ self.covariance @ A.T + scan.motion_covariance


class SlamGraph:
    """Follows a run, one scan after the other.

    Args:
        config: how.
        directory: where submaps are kept meanwhile, in a file without a name; None: where temporary files are.
    """

    def __init__(self, config: SlamGraphConfig, directory: Path | None = None) -> None:
        self._config = config
        self._selector = KeyframeSelector(config.keyframes)
        self._detector = LoopDetector(config.loops)
        self._graph = PoseGraph(config.optimiser)
        self._store = SubmapStore(directory)
        self._submap: GlobalMap | None = None  # of the last keyframe, in its frame
        self.scan_poses: list[FloatArray] = []  # as refined
        self._keyframe_scans: list[int] = []
        self._keyframe_way_m: list[float] = []
        self._registered: list[FloatArray | None] = []  # covariance of each keyframe's pose
        self._sessions: list[int] = []
        self._way, self._way_m, self._session = _Way(), 0.0, 0
        self.keyframe_ms: list[float] = []  # wall time of each, drawing left out
        self._edges: list[Edge] = []
        self._closures: list[LoopClosure] = []

    def draw(self, points: FloatArray, T_world_lidar: FloatArray, voxel_size_m: float) -> None:
        """Add points (N, 3) of the latest scan, at its pose as refined, to the submap of the last keyframe."""
        if not self._keyframe_scans:
            return
        if self._submap is None:
            self._submap = GlobalMap(voxel_size_m)
        T_world_keyframe = self.scan_poses[self._keyframe_scans[-1]]
        self._submap.add(points, inverse(T_world_keyframe) @ T_world_lidar)

    def add(self, scan: GraphScan) -> None:
        """Take the next scan; what the one before showed has been drawn by now."""
        if self.scan_poses:
            step_m = float(np.linalg.norm(scan.T_world_lidar[:3, 3] - self.scan_poses[-1][:3, 3]))
            self._way.go(scan, step_m)
            self._way_m += step_m
        self.scan_poses.append(scan.T_world_lidar)
        if scan.belongs_in_map and len(scan.points) and self._selector.is_due(scan.T_world_lidar, scan.points):
            started = time.perf_counter()
            self._selector.take(scan.T_world_lidar, scan.points)
            self._close_submap()
            self._begin_keyframe(scan)
            self.keyframe_ms.append(1e3 * (time.perf_counter() - started))

    def finish(self) -> Corrected | None:
        """Optimise everything; None when there is no keyframe."""
        if not self._keyframe_scans:
            return None
        self._close_submap()
        self._closures += self._detector.finish()
        optimised = self._graph.optimise()
        weights = iter(optimised.loop_weights)
        believed = tuple(c.verdict == "accepted" and bool(next(weights) > 0.5) for c in self._closures)
        loops = [_loop_edge(c) for c, kept in zip(self._closures, believed, strict=True) if kept]
        keys = np.arange(len(self._keyframe_scans))
        return Corrected(
            corrected(np.array(self.scan_poses), np.array(self._keyframe_scans), optimised.poses),
            np.array(self._keyframe_scans),
            tuple(self._closures),
            believed,
            GraphFile(keys, optimised.poses, (*self._edges, *loops)),
        )

    def draw_map(self, result: Corrected, voxel_size_m: float) -> GlobalMap:
        """All submaps at their keyframes' corrected poses."""
        drawn = GlobalMap(voxel_size_m)
        for index, pose in enumerate(result.graph.poses):
            drawn.add_means(self._store[index], pose)
        return drawn

    def close(self) -> None:
        """Give up what is kept on disk."""
        self._store.close()

    def _begin_keyframe(self, scan: GraphScan) -> None:
        key = len(self._keyframe_scans)
        way, self._way = self._way, _Way()
        if not key:
            self._graph.add_pose(0, scan.T_world_lidar)
        else:
            T_first_second = inverse(self.scan_poses[self._keyframe_scans[-1]]) @ scan.T_world_lidar
            self._graph.add_pose(key, self._graph.pose(key - 1) @ T_first_second)
            for edge in self._edges_between(key, T_first_second, way, scan):
                self._graph.add_edge(edge)
                self._edges.append(edge)
            self._session += way.lost  # drift does not explain what happens meanwhile
        self._keyframe_scans.append(len(self.scan_poses) - 1)
        self._keyframe_way_m.append(self._way_m)
        self._registered.append(scan.covariance)
        self._sessions.append(self._session)

    def _edges_between(self, key: int, T_first_second: FloatArray, way: _Way, scan: GraphScan) -> list[Edge]:
        """From the last keyframe to this one: what the trajectory says, and what the odometry says beside it."""
        config, mapped = self._config.edges, scan.covariance is not None
        covariance = trajectory_covariance(way.length_m, mapped, way.lost, config)
        if mapped and scan.covariance is not None and self._registered[-1] is not None and not way.lost:
            A = adjoint(inverse(T_first_second))
            covariance = covariance + scan.covariance + A @ self._registered[-1] @ A.T
        edges = [Edge(key - 1, key, T_first_second, covariance, "refinement" if mapped else "odometry")]
        if mapped and way.T_keyframe_lidar is not None:
            doubted = config.odometry_caution**2 * way.covariance
            edges.append(Edge(key - 1, key, way.T_keyframe_lidar, doubted, "odometry"))
        return edges

    def _close_submap(self) -> None:
        """The last keyframe has been seen enough of: keep its submap, and look for it among those before."""
        if not self._keyframe_scans:
            return
        index = len(self._keyframe_scans) - 1
        submap, self._submap = self._submap or GlobalMap(1.0), None
        means = submap.means()
        self._store.append(means)
        self._graph.update()
        points = means.points
        found = self._detector.add(
            Submap(index, self._sessions[index], self._keyframe_way_m[index], points), self._graph.poses()
        )
        self._closures += found
        accepted = [closure for closure in found if closure.verdict == "accepted"]
        for closure in accepted:
            self._graph.add_edge(_loop_edge(closure))
        if accepted:
            self._graph.update()


def _loop_edge(closure: LoopClosure) -> Edge:
    return Edge(closure.first, closure.second, closure.T_first_second, closure.covariance, "loop")


def trajectory_covariance(length_m: float, mapped: bool, lost: bool, config: TrajectoryEdgeConfig) -> FloatArray:
    """(6, 6) of the motion from one keyframe to the next, as far as drift goes; rotation first."""
    if lost:
        sigma_deg, sigma_m = config.lost_rotation_deg, config.lost_translation_m + 0.5 * length_m
    else:
        factor = 1.0 if mapped else config.unmapped_factor
        sigma_deg = factor * (config.rotation_deg + config.drift_deg_per_m * length_m)
        sigma_m = factor * (config.translation_m + 0.01 * config.drift_percent * length_m)
    return np.diag(np.array([np.deg2rad(sigma_deg)] * 3 + [sigma_m] * 3) ** 2)
