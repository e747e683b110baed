"""A triangle mesh of a map: screened Poisson reconstruction by Open3D, trimmed to where there are points."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.global_map.point_cloud import PointCloud

# The octree's finest level; deeper ones take minutes and gigabytes.
_DEEPEST = 12
# Reconstructed surface farther from the points is invented.
_TRIM_CELLS = 1.0


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with vertices in the world."""

    vertices: FloatArray  # (N, 3)
    triangles: NDArray[np.int32]  # (M, 3) indices of vertices
    colours: NDArray[np.uint8] | None  # (N, 3) red, green, blue; None when the map has none


def reconstruct(cloud: PointCloud, cell_m: float) -> Mesh:
    """The surface through the points of a map with normals (M. Kazhdan and H. Hoppe, ToG 2013).

    Vertices without a point within the edge of a cell are removed.

    Args:
        cloud: the map.
        cell_m: edge of the octree's finest cells; larger in a map of more than 2^12 of them.
    """
    import open3d as o3d

    extent = float(np.ptp(cloud.points, axis=0).max()) * 1.1
    depth = int(np.clip(math.ceil(math.log2(max(extent / cell_m, 2.0))), 4, _DEEPEST))
    given = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points))
    given.normals = o3d.utility.Vector3dVector(cloud.normals)
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        surface, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(given, depth=depth, n_threads=1)
    distance, nearest = cKDTree(cloud.points).query(np.asarray(surface.vertices))
    finest = max(cell_m, extent / 2**depth)
    far = distance > _TRIM_CELLS * finest
    surface.remove_vertices_by_mask(far)
    rgb = cloud.attributes.rgb
    return Mesh(
        np.asarray(surface.vertices),
        np.asarray(surface.triangles),
        None if rgb is None else rgb[np.asarray(nearest)[~far]],
    )
