"""Maps on disk."""

from pathlib import Path

import numpy as np

from lidarslam.core.errors import OutputError
from mapping.global_map import PointCloud


def write_cloud(path: Path, cloud: PointCloud) -> None:
    """Write a binary .ply or .pcd file with float32 points and normals.

    Raises:
        OutputError: the file could not be written, or the cloud is empty.
    """
    if not len(cloud):
        raise OutputError(f"{path.parent}: a map without points cannot be written")
    import open3d as o3d

    out = o3d.t.geometry.PointCloud(o3d.core.Tensor.from_numpy(cloud.points.astype(np.float32)))
    out.point.normals = o3d.core.Tensor.from_numpy(cloud.normals.astype(np.float32))
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        written = o3d.t.io.write_point_cloud(path, out, write_ascii=False)
    if not written:
        raise OutputError(
            f"{path.parent}: the {path.suffix} map cannot be written there; is the disk full or the folder read-only?"
        )
