"""Edits of a finished map: joined, cleaned, levelled, cropped; and its surface as a mesh."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray, transform_points
from lidarslam.core.scan import PointAttributes
from lidarslam.mapping.global_map.point_cloud import PointCloud, estimate_normals

# Angles about the present direction within which normals are averaged to the next.
_NARROWING = np.deg2rad([45.0, 30.0, 20.0, 10.0, 5.0, 5.0])
# Distance of the ground's points from its plane, and how often this is fitted.
_GROUND_M, _REFITS = 0.1, 10
_FEWEST = 100
# The octree's finest level; deeper ones take minutes and gigabytes.
_DEEPEST = 12
# Reconstructed surface farther from the points is extrapolated.
_TRIM_CELLS = 1.0


@dataclass(frozen=True, eq=False)
class GroundPlane:
    """The plane of the ground, `up @ p = height_m`."""

    up: FloatArray  # (3,) unit normal
    height_m: float
    share: float  # of the points that face upwards


def moved(cloud: PointCloud, T: FloatArray) -> PointCloud:
    """The cloud with its points and normals in another frame."""
    return PointCloud(transform_points(T, cloud.points), cloud.normals @ T[:3, :3].T, cloud.attributes)


def joined(clouds: Sequence[PointCloud]) -> PointCloud:
    """Clouds of one frame, with the attributes that all of them have."""
    present = [dict(cloud.attributes.present()) for cloud in clouds]
    names = [name for name in present[0] if all(name in one for one in present)]
    attributes = {name: np.concatenate([one[name] for one in present]) for name in names}
    return PointCloud(
        np.concatenate([cloud.points for cloud in clouds]),
        np.concatenate([cloud.normals for cloud in clouds]),
        PointAttributes(**attributes),
    )


def without_outliers(
    cloud: PointCloud, sigmas: tuple[int, float] | None, radius: tuple[int, float] | None
) -> PointCloud:
    """The cloud without floaters, by Open3D.

    Left out are points whose mean distance to k neighbours exceeds the mean of all by more than s standard deviations,
    for `sigmas` (k, s), and points with fewer than k neighbours within r metres, for `radius` (k, r).
    """
    for method, parameters in (("remove_statistical_outlier", sigmas), ("remove_radius_outlier", radius)):
        if parameters is not None:
            _, kept = getattr(cloud.to_open3d(), method)(*parameters)
            cloud = cloud.select(np.sort(np.asarray(kept, dtype=np.intp)))
    return cloud


def ground_plane(cloud: PointCloud) -> GroundPlane | None:
    """The level with the most points that face upwards; None if few do, within 45 degrees of z.

    The most frequent normal comes first, for which the treads of stairs are level, then the plane of the points there.
    """
    normals = cloud.normals
    if len(cloud) and not np.ptp(normals, axis=0).any():  # a file without normals
        normals = estimate_normals(cloud.points)
        normals = normals * np.where(normals[:, 2:] < 0.0, -1.0, 1.0)
    facing = normals[:, 2] > np.cos(_NARROWING[0])
    points, normals = cloud.points[facing], normals[facing]
    if len(points) < _FEWEST:
        return None
    up, alike = np.array([0.0, 0.0, 1.0]), np.ones(len(points), dtype=np.bool_)
    for angle in _NARROWING:
        chosen = normals @ up > np.cos(angle)
        if chosen.sum() < _FEWEST:
            break
        alike = chosen
        up = normals[alike].mean(axis=0)
        up /= np.linalg.norm(up)
    level = points[alike]
    bins = np.floor(level @ up / _GROUND_M).astype(np.intp)
    height_m = _GROUND_M * (float(bins.min() + np.bincount(bins - bins.min()).argmax()) + 0.5)
    for _ in range(_REFITS):
        ground = level[np.abs(level @ up - height_m) < _GROUND_M]
        if len(ground) < _FEWEST:
            return None
        middle = ground.mean(axis=0)
        up = np.linalg.svd(ground - middle, full_matrices=False)[2][2]
        up *= np.sign(up[2])
        height_m = float(up @ middle)
    share = float(np.mean(np.abs(points @ up - height_m) < _GROUND_M))
    return GroundPlane(up, height_m, share) if up[2] > np.cos(_NARROWING[0]) else None


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with vertices in the world."""

    vertices: FloatArray  # (N, 3)
    triangles: NDArray[np.int32]  # (M, 3) indices of vertices
    colours: NDArray[np.uint8] | None  # (N, 3) red, green, blue; None when the map has none


def reconstruct(cloud: PointCloud, cell_m: float) -> Mesh:
    """The surface through the points of a map with normals (M. Kazhdan and H. Hoppe, ToG 2013).

    The octree's finest cells have an edge of `cell_m`, larger in a map of more than 2^12 of them. Vertices without a
    point within it are removed.
    """
    import open3d as o3d

    extent = float(np.ptp(cloud.points, axis=0).max()) * 1.1
    depth = int(np.clip(math.ceil(math.log2(max(extent / cell_m, 2.0))), 4, _DEEPEST))
    given = cloud.to_open3d()
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
