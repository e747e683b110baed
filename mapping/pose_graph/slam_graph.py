"""Simultaneous localisation and mapping with memory: keyframes, loops among them, and what they do to all poses.

Scans come with the poses that scan-to-map refinement gave them. Some become keyframes; what is seen until the next is
the submap of each. Between keyframes the trajectory and the odometry are edges of the pose graph, and wherever a
submap turns out to show a place seen before, so is the closure. In the end all of it is optimised together, the scans
between keyframes follow, and the map is drawn anew from the submaps.

Several recordings of one place may follow one another. No edge leads from one to the next; those that loops join end up
in one frame.
"""

import time
from collections.abc import Collection
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.state import Saved, State, stack
from mapping.global_map.global_map import GlobalMap
from mapping.loops.detection import LoopClosure, LoopDetector, Submap, closures_state, restored_closures
from mapping.loops.refinement import DenseSubmap, refine
from mapping.loops.revisits import as_registered
from mapping.pose_graph.components import Sessions
from mapping.pose_graph.correction import corrected
from mapping.pose_graph.edges import Way, trajectory_covariance, trajectory_edges
from mapping.pose_graph.g2o import Edge, GraphFile, edges_state, restored_edges
from mapping.pose_graph.graph_config import SlamGraphConfig
from mapping.pose_graph.graph_scan import GraphScan
from mapping.pose_graph.keyframes import KeyframeSelector
from mapping.pose_graph.optimizer import PoseGraph
from mapping.pose_graph.submap_store import SubmapStore

# A closure is refined on submaps united with so many on either side: one alone is as sparse as the sensor, and over a
# longer way drift bends them.
_REACH = 1


@dataclass(frozen=True, eq=False)
class Corrected:
    """What the graph came to.

    Attributes:
        T_world_lidar: (M, 4, 4) of all scans, one recording's after the other's.
        keyframe_scans: (K,) which of them are keyframes.
        closures: all that were looked at closely, refused ones too; `believed` (same length) says which the optimiser
            kept in the end.
        graph: keyframes and edges, refused closures left out.
        first_scans: (R,) where the scans of each recording begin.
        frames: (R,) whose world each recording is in: that of the first of those that believed closures join it with,
            which may be itself.
    """

    T_world_lidar: FloatArray
    keyframe_scans: NDArray[np.intp]
    closures: tuple[LoopClosure, ...]
    believed: tuple[bool, ...]
    graph: GraphFile
    first_scans: NDArray[np.intp]
    frames: NDArray[np.intp]

    @property
    def keyframe_recordings(self) -> NDArray[np.intp]:
        """(K,) which recording each keyframe is of."""
        return _recordings_of(self.keyframe_scans, self.first_scans)


class SlamGraph:
    """Follows a run, one scan after the other, or several runs, one after the other.

    Args:
        config: how.
        directory: where submaps are kept meanwhile, in a file without a name; None: where temporary files are.
        file: where they are kept instead, so that `restore` finds them.
        local_radius_m: of the local map that scans were registered to; 0 without one.
    """

    def __init__(
        self,
        config: SlamGraphConfig,
        directory: Path | None = None,
        file: Path | None = None,
        local_radius_m: float = 0.0,
    ) -> None:
        self._config = config
        self._local_radius_m = local_radius_m
        self._selector = KeyframeSelector(config.keyframes)
        self._detector = LoopDetector(config.loops)
        self._graph = PoseGraph(config.optimiser)
        self._store = SubmapStore(directory, file)
        self._is_submap_open = False  # is more to come of what is seen from the last keyframe?
        self._submap: GlobalMap | None = None  # of the last keyframe, in its frame
        self.scan_poses: list[FloatArray] = []  # as refined, each recording's in its own world
        self._first_scans = [0]
        self._keyframe_scans: list[int] = []
        self._keyframe_way_m: list[float] = []
        self._registered: list[FloatArray | None] = []  # covariance of each keyframe's pose
        self._sessions: list[int] = []
        self._way, self._way_m, self._session = Way(), 0.0, 0
        self.keyframe_ms: list[float] = []  # wall time of each, drawing left out
        self._edges: list[Edge] = []
        self._closures: list[LoopClosure] = []
        self._unrefined: list[int] = []  # accepted closures, neighbours of whose later keyframe are still to come

    def state(self) -> State:
        """All of it, but for what lies in the file of submaps.

        Raises:
            OSError: the disk is full.
        """
        known = np.array([covariance is not None for covariance in self._registered], dtype=np.bool_)
        covariances = [np.zeros((6, 6)) if covariance is None else covariance for covariance in self._registered]
        return {
            "selector": self._selector.state(),
            "detector": self._detector.state(),
            "graph": self._graph.state(),
            "store": self._store.state(),
            "is_submap_open": self._is_submap_open,
            "submap": None if self._submap is None else self._submap.state(),
            "scan_poses": stack(self.scan_poses, (4, 4)),
            "first_scans": list(self._first_scans),
            "keyframe_scans": list(self._keyframe_scans),
            "keyframe_way_m": list(self._keyframe_way_m),
            "registered": known,
            "registered_covariance": stack(covariances, (6, 6)),
            "sessions": list(self._sessions),
            "way": dict(vars(self._way)),
            "way_m": self._way_m,
            "session": int(self._session),
            "keyframe_ms": list(self.keyframe_ms),
            "edges": edges_state(self._edges),
            "closures": closures_state(self._closures),
            "unrefined": list(self._unrefined),
        }

    @classmethod
    def restored(cls, config: SlamGraphConfig, saved: Saved, file: Path, local_radius_m: float = 0.0) -> "SlamGraph":
        """The graph with a state, whose submaps lie in a file.

        Raises:
            InputError: the file is damaged.
        """
        graph = cls(config, local_radius_m=local_radius_m)
        graph._store.close()
        graph._store = SubmapStore.restored(saved.part("store"), file)
        graph._selector.restore(saved.part("selector"))
        graph._detector.restore(saved.part("detector"), (means.points for means in graph._store))
        graph._graph.restore(saved.part("graph"))
        graph._is_submap_open = saved.flag("is_submap_open")
        graph._submap = saved.optional("submap", GlobalMap.restored)
        graph.scan_poses = list(saved.array("scan_poses", (None, 4, 4)))
        graph._first_scans = saved.integers("first_scans")
        graph._keyframe_scans, graph._sessions = saved.integers("keyframe_scans"), saved.integers("sessions")
        graph._keyframe_way_m, graph.keyframe_ms = saved.numbers("keyframe_way_m"), saved.numbers("keyframe_ms")
        count = len(graph._keyframe_scans)
        known = saved.array("registered", (count,), np.bool_)
        covariances = saved.array("registered_covariance", (count, 6, 6))
        graph._registered = [C if there else None for C, there in zip(covariances, known, strict=True)]
        graph._way.restore(saved.part("way"))
        graph._way_m, graph._session = saved.number("way_m"), saved.integer("session")
        graph._edges = restored_edges(saved.part("edges"))
        graph._closures = restored_closures(saved.part("closures"))
        graph._unrefined = saved.integers("unrefined")
        return graph

    def begin_recording(self) -> None:
        """The next scan is the first of another recording: nobody knows where it lies, nor how it got there."""
        self._close_submap()
        self._first_scans.append(len(self.scan_poses))
        self._selector = KeyframeSelector(self._config.keyframes)
        self._way, self._way_m, self._session = Way(), 0.0, self._session + 1

    def draw(self, points: FloatArray, T_world_lidar: FloatArray, voxel_size_m: float) -> None:
        """Add points (N, 3) of the latest scan, at its pose as refined, to the submap of the last keyframe."""
        if not self._is_submap_open:
            return
        if self._submap is None:
            self._submap = GlobalMap(voxel_size_m)
        T_world_keyframe = self.scan_poses[self._keyframe_scans[-1]]
        self._submap.add(points, inverse(T_world_keyframe) @ T_world_lidar)

    def add(self, scan: GraphScan) -> None:
        """Take the next scan; what the one before showed has been drawn by now."""
        if len(self.scan_poses) > self._first_scans[-1]:
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
        poses = self._graph.poses()
        self._refine_closures(poses, until=len(poses))
        optimised = self._with_refined_loops(poses).optimise()
        weights = iter(optimised.loop_weights)
        believed = tuple(c.verdict == "accepted" and bool(next(weights) > 0.5) for c in self._closures)
        loops = [_loop_edge(c) for c, kept in zip(self._closures, believed, strict=True) if kept]
        scans, firsts = np.array(self._keyframe_scans), np.array(self._first_scans)
        recordings = _recordings_of(scans, firsts)
        frames = _joined(recordings, len(firsts), loops)
        poses = self._in_frames(optimised.poses, frames[recordings])
        return Corrected(
            self._correct_scans(poses, recordings),
            scans,
            tuple(self._closures),
            believed,
            GraphFile(np.arange(len(scans)), poses, (*self._edges, *loops)),
            firsts,
            frames,
        )

    def _in_frames(self, poses: FloatArray, frames: NDArray[np.intp]) -> FloatArray:
        """Move poses (K, 4, 4) in one piece for each frame (K,), so that its first keyframe is where it was refined.

        What a closure moved stays there when the closure turns out to be wrong, and no edge takes it back.
        """
        moved = poses.copy()
        for frame in np.unique(frames)[1:]:  # the graph holds the first
            keys = np.flatnonzero(frames == frame)
            T_frame_found = self.scan_poses[self._keyframe_scans[keys[0]]] @ inverse(poses[keys[0]])
            moved[keys] = T_frame_found @ poses[keys]
        return moved

    def _correct_scans(self, poses: FloatArray, recordings: NDArray[np.intp]) -> FloatArray:
        """All scans (M, 4, 4), each recording's by the poses (K, 4, 4) of its own keyframes; as refined without any."""
        scans, keyframes = np.array(self.scan_poses), np.array(self._keyframe_scans)
        for recording, (begin, end) in enumerate(pairwise([*self._first_scans, len(scans)])):
            own = recordings == recording
            if own.any():
                scans[begin:end] = corrected(scans[begin:end], keyframes[own] - begin, poses[own])
        return scans

    def draw_map(self, result: Corrected, voxel_size_m: float, recordings: Collection[int] | None = None) -> GlobalMap:
        """The submaps of some recordings, or of all, at their keyframes' corrected poses."""
        drawn = GlobalMap(voxel_size_m)
        for index, (pose, recording) in enumerate(zip(result.graph.poses, result.keyframe_recordings, strict=True)):
            if recordings is None or recording in recordings:
                drawn.add_means(self._store[index], pose)
        return drawn

    def close(self) -> None:
        """Give up what is kept on disk."""
        self._store.close()

    def _begin_keyframe(self, scan: GraphScan) -> None:
        key = len(self._keyframe_scans)
        way, self._way = self._way, Way()
        if not key or self._keyframe_scans[-1] < self._first_scans[-1]:
            self._graph.add_pose(key, scan.T_world_lidar)
        else:
            T_first_second = inverse(self.scan_poses[self._keyframe_scans[-1]]) @ scan.T_world_lidar
            self._graph.add_pose(key, self._graph.pose(key - 1) @ T_first_second)
            before, config = self._registered[-1], self._config.edges
            for edge in trajectory_edges(key, T_first_second, way, before, scan.covariance, config):
                self._graph.add_edge(edge)
                self._edges.append(edge)
            self._session += way.lost  # drift does not explain what happens meanwhile
        self._keyframe_scans.append(len(self.scan_poses) - 1)
        self._keyframe_way_m.append(self._way_m)
        self._registered.append(scan.covariance)
        self._sessions.append(self._session)
        self._is_submap_open = True

    def _close_submap(self) -> None:
        """The last keyframe has been seen enough of: keep its submap, and look for it among those before."""
        if not self._is_submap_open:
            return
        self._is_submap_open = False
        index = len(self._keyframe_scans) - 1
        submap, self._submap = self._submap or GlobalMap(1.0), None
        means = submap.means()
        self._store.append(means)
        self._graph.update()
        seen = Submap(index, self._sessions[index], self._keyframe_way_m[index], means.points)
        poses = self._graph.poses()
        found = self._detector.add(seen, poses)
        self._unrefined += [len(self._closures) + i for i, c in enumerate(found) if c.verdict == "accepted"]
        self._closures += found
        accepted = [closure for closure in found if closure.verdict == "accepted"]
        for closure in accepted:
            self._graph.add_edge(_loop_edge(closure))
        if accepted:
            self._graph.update()
        self._refine_closures(poses, until=index - _REACH)

    def _refine_closures(self, poses: FloatArray, until: int) -> None:
        """Register accepted closures again whose later keyframe is not after `until`: its neighbours are all there."""
        for row in [row for row in self._unrefined if self._closures[row].second <= until]:
            self._unrefined.remove(row)
            self._closures[row] = self._refined(self._closures[row], poses)

    def _refined(self, closure: LoopClosure, poses: FloatArray) -> LoopClosure:
        """A closure registered on all points of both places."""
        cell_m = max(self._detector.cell_m(key) for key in (closure.first, closure.second))
        target, source = (self._dense_submap(key, poses, cell_m) for key in (closure.first, closure.second))
        drift = self._drift_within(closure.first) + self._drift_within(closure.second)
        refined = refine(target, source, closure.T_first_second, closure.covariance, drift)
        if refined is not None:
            closure = replace(closure, T_first_second=refined.T_target_source, covariance=refined.covariance)
        if self._sessions[closure.first] != self._sessions[closure.second]:  # another recording, or lost on the way
            return closure
        begin, end = self._keyframe_scans[closure.first], self._keyframe_scans[closure.second]
        way = np.array(self.scan_poses[begin : end + 1])
        registered = self._registered[closure.first], self._registered[closure.second]
        return as_registered(closure, way, *registered, self._local_radius_m)

    def _dense_submap(self, key: int, poses: FloatArray, cell_m: float) -> DenseSubmap:
        """A keyframe's submap united with its neighbours' of the same session, which poses (K, 4, 4) place."""
        submaps = [(inverse(poses[key]) @ poses[k], self._store[k].points) for k in self._around(key)]
        return DenseSubmap.join(submaps, self._config.loops.max_range_m, cell_m)

    def _around(self, key: int) -> list[int]:
        """A keyframe with those beside it in its session that have submaps by now."""
        near = range(max(0, key - _REACH), min(len(self._store), key + _REACH + 1))
        return [k for k in near if self._sessions[k] == self._sessions[key]]

    def _drift_within(self, key: int) -> FloatArray:
        """(6, 6) of a keyframe united with those beside it; each axis has a third of the square."""
        ways_m = [abs(self._keyframe_way_m[k] - self._keyframe_way_m[key]) for k in self._around(key)]
        return trajectory_covariance(max(ways_m), True, False, self._config.edges) / 3.0

    def _with_refined_loops(self, poses: FloatArray) -> PoseGraph:
        """All edges with the closures as they are now; the graph of the run has them as they were first verified."""
        graph = PoseGraph(self._config.optimiser)
        for key, pose in enumerate(poses):
            graph.add_pose(key, pose)
        loops = [_loop_edge(closure) for closure in self._closures if closure.verdict == "accepted"]
        for edge in (*self._edges, *loops):
            graph.add_edge(edge)
        return graph


def _recordings_of(scans: NDArray[np.intp], first_scans: NDArray[np.intp]) -> NDArray[np.intp]:
    return np.searchsorted(first_scans, scans, side="right") - 1


def _joined(recordings: NDArray[np.intp], count: int, loops: list[Edge]) -> NDArray[np.intp]:
    """For each of so many recordings the first of those that loops join it with; (K,) says whose each keyframe is."""
    sets = Sessions()
    for recording in range(count):
        sets.add(recording)
    for loop in loops:
        sets.join(int(recordings[loop.first]), int(recordings[loop.second]))
    return np.array([sets.first(recording) for recording in range(count)])


def _loop_edge(closure: LoopClosure) -> Edge:
    return Edge(closure.first, closure.second, closure.T_first_second, closure.covariance, "loop")
