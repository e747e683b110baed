"""What a run does with its pose graph: begin it, and in the end correct trajectory and map by it."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lidarslam.config import Config
from lidarslam.core.geometry import FloatArray, rotation_angle
from mapping.g2o import GraphFile
from mapping.global_map import GlobalMap

if TYPE_CHECKING:  # GTSAM takes a while to load
    from mapping.loop_closure import LoopClosure
    from mapping.slam_graph import SlamGraph


@dataclass(frozen=True)
class LoopReport:
    """One place seen twice, or nearly believed to be; for the summary.

    Attributes:
        first_scan, second_scan: which scans, the second the later one.
        accepted, reason: whether it is in the graph; why not.
        rest: overlap, residual and so on.
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

    def to_json(self) -> dict[str, Any]:
        """An entry of summary.json."""
        return {name: round(value, 4) if isinstance(value, float) else value for name, value in vars(self).items()}


@dataclass(frozen=True, eq=False)
class GraphOutcome:
    """What a pose graph did to a run.

    Attributes:
        T_world_lidar: (M, 4, 4) corrected poses of all scans.
        global_map: drawn anew.
        graph: for pose_graph.g2o.
        loops: accepted ones, and those that were looked at closely and refused.
        largest_correction_m: by how much a scan moved.
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


def begin_graph(config: Config, directory: Path | None = None) -> "SlamGraph | None":
    """A pose graph, when the configuration asks for one; what it puts aside lies in the directory."""
    if not config.pose_graph.enabled:
        return None
    from mapping.slam_graph import SlamGraph

    return SlamGraph(config.pose_graph, directory)


def finish_graph(graph: "SlamGraph", scans: int, voxel_size_m: float) -> GraphOutcome | None:
    """Close the loops of so many scans for good, and draw the map anew; None where no scan could be believed."""
    result = graph.finish()
    if result is None:
        return None
    before, after = np.array(graph.scan_poses[:scans]), result.T_world_lidar[:scans]
    moved = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
    return GraphOutcome(
        T_world_lidar=after,
        global_map=graph.draw_map(result, voxel_size_m),
        graph=result.graph,
        loops=tuple(
            _report(closure, believed, result.keyframe_scans.tolist())
            for closure, believed in zip(result.closures, result.believed, strict=True)
        ),
        largest_correction_m=float(moved.max(initial=0.0)),
        keyframe_ms=tuple(graph.keyframe_ms),
    )


def _report(closure: "LoopClosure", believed: bool, keyframe_scans: list[int]) -> LoopReport:
    outvoted = closure.verdict == "accepted" and not believed
    T = closure.T_first_second
    return LoopReport(
        first_scan=keyframe_scans[closure.first],
        second_scan=keyframe_scans[closure.second],
        accepted=believed,
        reason="does not fit the other edges of the graph" if outvoted else closure.reason,
        found_by=closure.found_by,
        overlap=closure.overlap,
        residual_m=closure.residual_m,
        inlier_ratio=closure.inlier_ratio,
        consistent=closure.consistent,
        distance_m=float(np.linalg.norm(T[:3, 3])),
        turn_deg=float(np.rad2deg(rotation_angle(T))),
    )
