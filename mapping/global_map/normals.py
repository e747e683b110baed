"""Normals of a cloud."""

import numpy as np

from lidarslam.core.geometry import FloatArray

# Nearest points that a normal is estimated from.
_NORMAL_NEIGHBOURS = 20


def estimate_normals(points: FloatArray) -> FloatArray:
    """Unit normals (N, 3) of points (N, 3) by PCA of the nearest ones; their sign is arbitrary."""
    if len(points) < 3:
        return np.tile([0.0, 0.0, 1.0], (len(points), 1))
    import open3d as o3d

    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor.from_numpy(np.ascontiguousarray(points)))
    cloud.estimate_normals(max_nn=_NORMAL_NEIGHBOURS)  # type: ignore[call-arg] # the stub lacks the defaults
    return np.array(cloud.point.normals.numpy(), dtype=np.float64)
