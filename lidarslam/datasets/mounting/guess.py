"""A guess of the mounting by the ground in the first scans, cautious: recordings that are upright are left alone."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.core.spin_axis import image_axes
from lidarslam.core.thinning import one_per_cell
from lidarslam.datasets.config import Mounting
from lidarslam.datasets.mounting.rotation import mounting_with_up, written

# A plane that faces up within this may be the ground of a sensor that is upright, or held at an angle.
_UPRIGHT = np.cos(np.deg2rad(50.0))
# Ground is taken from planes that face farther from up than this: normals of a few points are off by some degrees.
_TURNED = np.cos(np.deg2rad(60.0))
# No sensor but one that flies is farther above the ground.
_MOST_HEIGHT_M = 4.0
# Ground is seen within this of the spin axis, and the scans agree within as much.
_ALIKE = np.cos(np.deg2rad(25.0))
# A plane opposite with more than this share of the surfaces is a ceiling, or the other wall.
_MOST_OPPOSITE = 0.01
# A sensor that looks farther from its equator than the first on one side and less than the second on the other sees
# the ceiling and not the floor, or the other way round; strays are left out.
_FAR_TO_ONE_SIDE, _NEAR_TO_OTHER, _STRAY_SHARE = np.sin(np.deg2rad(35.0)), np.sin(np.deg2rad(9.0)), 0.005
_SCANS = 5
_ENOUGH_SCANS, _SOME_SCANS = 4, 2
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


@dataclass(frozen=True)
class Guess:
    """What the first scans show of the mounting."""

    mounting: Mounting = "upright"  # that acts
    warning: str | None = None  # what was guessed, or cannot be decided; with the setting


UPRIGHT = Guess()


def guess_mounting(scans: Iterable[FloatArray]) -> Guess:
    """The guess from the points (N, 3) of scans, of which no more are taken than needed."""
    found: list[FloatArray] = []
    unclear: list[FloatArray] = []
    for number, points in enumerate(scans):
        if number == _SCANS:
            break
        up, axis = _upwards(points)
        if up is not None:
            found.append(up)
        elif axis is not None:
            unclear.append(axis)
        if number == 0 and not found and not unclear:
            return UPRIGHT
    return _decide(found, unclear)


def _decide(found: Sequence[FloatArray], unclear: Sequence[FloatArray]) -> Guess:
    mean = np.sum(found, axis=0) if found else np.zeros(3)
    agreeing = [up for up in found if up @ mean > _ALIKE * np.linalg.norm(mean)]
    if len(agreeing) >= _SOME_SCANS:
        up = np.sum(agreeing, axis=0)
        mounting = mounting_with_up(up / np.linalg.norm(up))
        setting = f"--set reader.mounting={written(mounting)}"
        if len(agreeing) >= _ENOUGH_SCANS:
            return Guess(
                mounting,
                f"the ground in the first scans shows that z is not up; taken as {setting}, which makes this certain"
                " (--set reader.mounting=upright leaves the scans as they are)",
            )
        return Guess(warning=f"z may not be up in this recording; if so, use {setting}")
    if len(unclear) >= _ENOUGH_SCANS:
        ways = " or ".join(written(mounting_with_up(sign * unclear[0])) for sign in (1.0, -1.0))
        return Guess(
            warning="the scans were not taken about the z axis, and no ground shows which way is up; if it is not z,"
            f" use --set reader.mounting={ways}"
        )
    return UPRIGHT


def _upwards(points: FloatArray) -> tuple[FloatArray | None, FloatArray | None]:
    """The upwards direction (3,), if it is far from z and clear; and the spin axis (3,) if z is neither."""
    seen = planes(points)
    if not seen or any(_may_be_upright(plane, None) for plane in seen if plane.height_m < _MOST_HEIGHT_M):
        return None, None
    R_image_recorded = image_axes(points)
    if _sees_one_side(points, R_image_recorded[2]):
        return None, None
    axis = None if np.array_equal(R_image_recorded, np.eye(3)) else R_image_recorded[2]
    # Beside the spin axis a wall is like the ground of a sensor on its side.
    across = [plane for plane in seen if abs(plane.up @ R_image_recorded[2]) > _UPRIGHT]
    grounds = [plane for plane in across if plane.up[2] < _TURNED and _is_ground(plane, seen, axis)]
    largest = max(grounds, key=lambda plane: plane.share, default=None)
    if any(_may_be_upright(plane, largest) for plane in seen):
        return None, None
    if largest is not None:
        return largest.up, axis
    return None, axis if axis is not None and abs(axis[2]) < _TURNED else None


def _sees_one_side(points: FloatArray, axis: FloatArray) -> bool:
    """Whether points (N, 3) lie far to one side of the equator of an axis (3,), and hardly any to the other."""
    ranges = np.linalg.norm(points, axis=1)
    usable = ranges > 0.0
    low, high = np.quantile(points[usable] @ axis / ranges[usable], [_STRAY_SHARE, 1.0 - _STRAY_SHARE])
    return bool(min(-low, high) < _NEAR_TO_OTHER and max(-low, high) > _FAR_TO_ONE_SIDE)


def _is_ground(plane: Plane, seen: Sequence[Plane], axis: FloatArray | None) -> bool:
    """Whether a plane is the ground without doubt; less is asked of one that the sensor spins parallel to."""
    if plane.height_m > _MOST_HEIGHT_M:
        return False
    opposite = max((other.share for other in seen if other.up @ plane.up < -_ALIKE), default=0.0)
    if axis is not None and abs(plane.up @ axis) > _ALIKE:
        is_alone = opposite < 0.25 * plane.share
        return plane.share > 0.03 and plane.sectors >= 6 and plane.beyond < 0.02 and is_alone
    is_alone = opposite < _MOST_OPPOSITE
    return plane.share > 0.08 and plane.sectors >= 9 and plane.beyond < 0.01 and is_alone


def _may_be_upright(plane: Plane, ground: Plane | None) -> bool:
    """Whether a plane that faces up may be the ground, so that the recording is upright."""
    if plane.up[2] < _UPRIGHT or plane.share < 0.01 or plane.sectors < 4:
        return False
    if plane.height_m < _MOST_HEIGHT_M:
        return plane.beyond < 0.03 or (ground is not None and plane.share > 0.25 * ground.share)
    return plane.beyond < 0.01 and (ground is None or plane.share > ground.share)
