"""The ground in a scan: a plane close below the sensor, all around it, with nothing beneath."""

from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.core.thinning import one_per_cell

# Points farther than so many median ranges are left out; cells are this share of the median range.
_FAR, _CELL_SHARE, _LEAST_CELL_M = 4.0, 1.0 / 30.0, 0.05
_MOST_READ, _MOST_POINTS, _MOST_NORMALS, _NEIGHBOURS = 40_000, 8000, 3000, 10
# Neighbours lie in a plane when the least variance is this share of the next.
_FLAT = 0.05
# A plane's normals are within this of one another, its points within a step of height of one another.
_PARALLEL, _STEP_M = np.cos(np.deg2rad(15.0)), 0.3
_ROUNDS, _SEEDS, _FEWEST = 3, 48, 10
_SECTORS, _IN_SECTOR = 12, 2
# Points this far beneath a plane, and by this share of their range, are beyond it.
_BENEATH_M, _BENEATH_SHARE = 0.5, 0.05


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane that the sensor sees from one side."""

    up: FloatArray  # (3,) unit normal towards the sensor
    height_m: float  # of the sensor above it
    share: float  # of the scan's surfaces
    sectors: int  # of 12 around the normal, in which it was seen
    beyond: float  # share of the points that are beyond it


def planes(points: FloatArray) -> list[Plane]:
    """The planes in a scan (N, 3), one for each direction of their normals, the largest first."""
    thinned, on, normals = _normals(points)
    if len(normals) < _FEWEST:
        return []
    seeds = _sphere(_SEEDS)
    found: list[Plane] = []
    for seed in seeds[np.argsort(-(normals @ seeds.T > _PARALLEL).sum(axis=0), kind="stable")]:
        plane = _plane(seed, thinned, on, normals)
        if plane is not None and not any(plane.up @ other.up > _PARALLEL for other in found):
            found.append(plane)
    return sorted(found, key=lambda plane: -plane.share)


def _plane(up: FloatArray, thinned: FloatArray, on: FloatArray, normals: FloatArray) -> Plane | None:
    """The plane with the most of the surfaces `on` (M, 3) whose normals (M, 3) are near a direction (3,)."""
    chosen = np.zeros(len(normals), dtype=np.bool_)
    for _ in range(_ROUNDS):
        near = np.flatnonzero(normals @ up > _PARALLEL)
        heights = -(on[near] @ up)
        near, heights = near[heights > 0.0], heights[heights > 0.0]
        if len(near) < _FEWEST:
            return None
        bins = (heights / _STEP_M).astype(np.intp)
        counts = np.bincount(bins, minlength=2)
        lower = int(np.argmax(counts[:-1] + counts[1:]))
        chosen = near[(bins == lower) | (bins == lower + 1)]
        up = normals[chosen].mean(axis=0)
        up = up / np.linalg.norm(up)
    height_m = float(np.median(-(on[chosen] @ up)))
    across = np.linalg.svd(up[None])[2][1:]
    x, y = across @ on[chosen].T
    sectors = np.floor((np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * _SECTORS).astype(np.intp) % _SECTORS
    seen = int((np.bincount(sectors, minlength=_SECTORS) >= _IN_SECTOR).sum())
    beneath = -(thinned @ up) > height_m + _BENEATH_M + _BENEATH_SHARE * np.linalg.norm(thinned, axis=1)
    return Plane(up, height_m, len(chosen) / len(normals), seen, float(beneath.mean()))


def _normals(points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The thinned points (K, 3), some of them (M, 3) that lie on surfaces, and normals there (M, 3) to the sensor."""
    from scipy.spatial import cKDTree  # takes a while to load

    empty = np.empty((0, 3))
    few = points[:: max(1, len(points) // _MOST_READ)]
    ranges = np.linalg.norm(few, axis=1)
    if len(few) < _FEWEST:
        return empty, empty, empty
    median_m = float(np.median(ranges))
    cell_m = max(_LEAST_CELL_M, _CELL_SHARE * median_m)
    near = np.ascontiguousarray(few[ranges < _FAR * median_m])
    thinned = near[one_per_cell(near, cell_m)]
    thinned = thinned[:: -(-len(thinned) // _MOST_POINTS)]
    if len(thinned) < _NEIGHBOURS:
        return thinned, empty, empty
    asked = thinned[:: -(-len(thinned) // _MOST_NORMALS)]
    found = cKDTree(thinned).query(asked, k=_NEIGHBOURS)
    distances, index = np.asarray(found[0]), np.asarray(found[1])
    index = index[distances[:, -1] < 6.0 * cell_m]
    neighbours = thinned[index]
    means = neighbours.mean(axis=1)
    offsets = neighbours - means[:, None]
    variances, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))
    flat = variances[:, 0] < _FLAT * variances[:, 1]
    on, normals = means[flat], axes[flat, :, 0]
    return thinned, on, normals * -np.sign(np.einsum("ni,ni->n", normals, on))[:, None]


def _sphere(count: int) -> FloatArray:
    """Unit vectors (count, 3), evenly over the sphere, and the axes."""
    numbers = np.arange(count) + 0.5
    z, azimuth = 1.0 - 2.0 * numbers / count, np.pi * (1.0 + np.sqrt(5.0)) * numbers
    across = np.sqrt(1.0 - z**2)
    spread = np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), z])
    return np.concatenate([np.eye(3), -np.eye(3), spread])
