"""Who follows a run on a thread of its own, such as a pose graph, and what it is told."""

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Protocol

from lidarslam.core.geometry import FloatArray
from lidarslam.core.tracking import Status
from lidarslam.pipeline.localisation import Estimated, Localised
from mapping.pose_graph.graph_scan import GraphScan

# How many jobs the thread may lag behind: a loop may take as long as all the scans up to the next keyframe.
_MAX_BEHIND = 64


class Follower(Protocol):
    """Sees everything that a run comes to, scan by scan: what the scan before showed, then the next scan."""

    def draw(self, points: FloatArray, T_world_lidar: FloatArray, voxel_size_m: float) -> None:
        """Points (N, 3) of the latest scan, in its LiDAR frame, that belong in the map."""

    def add(self, scan: GraphScan) -> None:
        """The next scan."""


class Behind:
    """Lets a follower work on a thread of its own, and wait no longer than is good for the memory."""

    def __init__(self, follower: Follower) -> None:
        self._follower = follower
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="graph")
        self._jobs: deque[Future[None]] = deque()

    def draw(self, points: FloatArray, T_world_lidar: FloatArray, voxel_size_m: float) -> None:
        """See `Follower.draw`."""
        self._jobs.append(self._pool.submit(self._follower.draw, points, T_world_lidar, voxel_size_m))

    def add(self, scan: GraphScan) -> None:
        """See `Follower.add`."""
        self._jobs.append(self._pool.submit(self._follower.add, scan))
        while len(self._jobs) > _MAX_BEHIND:
            self._jobs.popleft().result()

    def catch_up(self) -> None:
        """Wait until all is done; an error of the follower's is raised."""
        while self._jobs:
            self._jobs.popleft().result()

    def finish(self) -> None:
        """Wait until all is done, for the last time."""
        self.catch_up()
        self._pool.shutdown()


def graph_scan(estimated: Estimated, localised: Localised, points: FloatArray) -> GraphScan:
    """What a follower is told of a scan: how it was found, and its compensated points (N, 3) in the LiDAR frame."""
    measured = estimated.interval_s is not None and (localised.way_known or localised.status is Status.LOST)
    return GraphScan(
        T_world_lidar=localised.T_world_lidar,
        points=points,
        covariance=localised.covariance,
        T_prev_curr=estimated.motion.T_prev_curr if measured else None,
        motion_covariance=estimated.motion.covariance if measured else None,
        lost=localised.status is Status.LOST or not localised.way_known,
        belongs_in_map=localised.belongs_in_map,
    )
