"""Submaps of keyframes united with those beside them, on which loop closures are refined."""

from collections.abc import Sequence
from dataclasses import dataclass

from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.mapping.global_map.global_map import means_points
from lidarslam.mapping.loops.refinement import DenseSubmap
from lidarslam.mapping.pose_graph.edges import drift_covariance
from lidarslam.mapping.pose_graph.keyframes import Keyframe
from lidarslam.mapping.pose_graph.submap_store import SubmapStore

# So many submaps on either side: one alone is as sparse as the sensor, and over a longer way drift bends them.
REACH = 1


@dataclass(frozen=True, eq=False)
class Neighbourhoods:
    """The keyframes with submaps, their poses and submaps."""

    keyframes: Sequence[Keyframe]
    poses: Sequence[FloatArray]  # (4, 4) of keyframes, as estimated now
    submaps: SubmapStore

    def submap(self, key: int, max_range_m: float, cell_m: float) -> DenseSubmap:
        """A keyframe's submap united with its neighbours' of the same segment."""
        T_keyframe_world = inverse(self.poses[key])
        submaps = [(T_keyframe_world @ self.poses[k], means_points(self.submaps[k])) for k in self._around(key)]
        return DenseSubmap.join(submaps, max_range_m, cell_m)

    def drift(self, key: int) -> FloatArray:
        """(6, 6) of a keyframe's neighbours relative to it; each axis has a third of the squared error."""
        path_m = self.keyframes[key].path_m
        return drift_covariance(max(abs(self.keyframes[k].path_m - path_m) for k in self._around(key))) / 3.0

    def _around(self, key: int) -> list[int]:
        """A keyframe with those beside it in its segment that have submaps by now."""
        near = range(max(0, key - REACH), min(len(self.submaps), key + REACH + 1))
        return [k for k in near if self.keyframes[k].segment == self.keyframes[key].segment]
