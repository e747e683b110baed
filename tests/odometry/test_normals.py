"""Normals of range images of surfaces that are known in closed form."""

import numpy as np
import pytest
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.odometry.images.normals import FINE_PATCHES, PATCHES, surface_normals

ROWS, COLUMNS = 16, 360
X, Y, Z = np.eye(3)


def rays(rows: int = ROWS, columns: int = COLUMNS, step_deg: float = 2.0) -> FloatArray:
    """Directions (3, H, W) through the centres of pixels, about the horizon."""
    elevation = np.deg2rad((np.arange(rows) - (rows - 1) / 2.0) * step_deg)[:, None]
    azimuth = (np.arange(columns) + 0.5) * (2.0 * np.pi / columns)
    parts = (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation))
    return np.stack(np.broadcast_arrays(*parts))


def image_of(directions: FloatArray, ranges: FloatArray, noise_m: float = 0.0) -> NDArray[np.float32]:
    """The image (4, H, W) of ranges (H, W) along rays; where infinite it is empty."""
    seen = np.isfinite(ranges)
    noisy = ranges + noise_m * np.random.default_rng(0).normal(size=ranges.shape)
    measured = np.where(seen, noisy, 0.0)
    return np.concatenate([directions * measured, measured[None]]).astype(np.float32)


def plane_ranges(directions: FloatArray, normal: FloatArray, distance: float) -> FloatArray:
    """Ranges to the plane that a unit normal faces the sensor from, at this distance; cut off at 40 m."""
    with np.errstate(divide="ignore"):
        ranges = distance / -np.einsum("ihw,i->hw", directions, normal)
    return np.where((ranges > 0.0) & (ranges < 40.0), ranges, np.inf)


def room(directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Ranges (H, W) in a room of 12 x 8 x 3 m, seen from its middle, and true normals (3, H, W)."""
    ranges = np.array([6.0, 4.0, 1.5])[:, None, None] / np.abs(directions)
    normals = np.moveaxis(np.eye(3)[ranges.argmin(axis=0)], -1, 0)
    return ranges.min(axis=0), -normals * np.sign(directions)


def there(normals: NDArray[np.float32]) -> NDArray[np.bool_]:
    return normals.any(axis=0)


def errors_deg(normals: NDArray[np.float32], truth: FloatArray) -> FloatArray:
    """Angles (K,) between normals (3, H, W), where there are any, and the true ones, (3, H, W) or (3,)."""
    found = normals.astype(np.float64)[:, there(normals)]
    expected = truth[:, None] if truth.ndim == 1 else truth[:, there(normals)]
    sine = np.linalg.norm(np.cross(found, expected, axis=0), axis=0)
    return np.rad2deg(np.arctan2(sine, (found * expected).sum(axis=0)))


@pytest.mark.parametrize(
    ("normal", "distance", "least_share"),
    [
        (Z, 0.5, 0.5),  # floor
        (-X, 5.0, 0.8),  # wall across the seam
        (Y, 2.0, 0.7),  # wall to the right
        (np.array([-0.6, -0.64, 0.48]), 4.0, 0.7),  # slope
    ],
)
@pytest.mark.parametrize(("noise_m", "median_deg", "worst_deg"), [(0.0, 0.01, 0.1), (0.01, 4.0, 25.0)])
def test_a_plane_gives_its_normal(normal, distance, least_share, noise_m, median_deg, worst_deg):
    image = image_of(rays(), plane_ranges(rays(), normal, distance), noise_m)
    normals = surface_normals(image)
    near = (image[3] > 0.0) & (image[3] < 4.0 * distance)
    assert there(normals)[near].mean() > least_share
    errors = errors_deg(normals, normal)
    assert np.median(errors) < median_deg
    assert errors.max() < worst_deg


@pytest.mark.parametrize(
    ("noise_m", "median_deg", "wrong_share"), [(0.0, 0.01, 0.1), (0.01, 2.0, 0.1), (0.03, 5.0, 0.2)]
)
def test_few_normals_in_a_room_are_wrong_and_all_are_unit_and_face_the_sensor(noise_m, median_deg, wrong_share):
    directions = rays(columns=720)
    ranges, truth = room(directions)
    image = image_of(directions, ranges, noise_m)
    normals = surface_normals(image)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=0), there(normals), atol=1e-5)
    assert ((normals * image[:3]).sum(axis=0)[there(normals)] < 0.0).all()
    errors = errors_deg(normals, truth)
    assert len(errors) > 0.8 * ROWS * 720
    assert np.median(errors) < median_deg
    assert (errors > 10.0).mean() < wrong_share


def test_edges_are_left_out_where_the_neighbourhood_is_no_plane():
    # In a corner of 90 degrees, 6 degrees wide, hardly any patch may pass for a plane that is neither wall.
    directions = rays(columns=720)
    image = image_of(directions, np.minimum(*(plane_ranges(directions, -axis, 4.0) for axis in (X, Y))))
    edge = slice(720 // 8 - 2, 720 // 8 + 2)
    lenient = [patch._replace(max_flatness=1.0) for patch in PATCHES]
    strict_share, lenient_share = (there(surface_normals(image, one))[:, edge].mean() for one in (PATCHES, lenient))
    assert strict_share < 0.1
    assert lenient_share > 0.8


@pytest.mark.parametrize("noise_m", [0.0, 0.03])
@pytest.mark.parametrize(("normal", "distance", "ring"), [(-X, 5.0, 5), (-X, 5.0, 7), (Z, 1.0, 2)])
def test_one_ring_has_no_normals(normal, distance, ring, noise_m):
    ranges = plane_ranges(rays(), normal, distance)
    ranges[np.arange(ROWS) != ring] = np.inf
    image = image_of(rays(), ranges, noise_m)
    assert (image[3] > 0.0).sum() > 100
    assert not surface_normals(image).any()


def test_sparse_rows_on_the_ground_get_a_normal_at_the_second_try():
    image = image_of(rays(), plane_ranges(rays(), Z, 1.8))
    first, both = surface_normals(image, PATCHES[:1]), surface_normals(image)
    apart_m = np.diff(image[3], axis=0).max(axis=1)  # from one ring to the next
    ring = np.flatnonzero((apart_m > 0.5) & (apart_m < 2.0))[-1]
    assert not first[:, ring].any()
    assert there(both)[ring].all()
    assert errors_deg(both, Z).max() < 0.1


def test_empty_pixels_have_no_normals_and_too_few_neighbours_neither():
    image = image_of(rays(), room(rays())[0])
    lost = np.random.default_rng(0).random((ROWS, COLUMNS)) < 0.7
    image[:, lost] = 0.0
    normals = surface_normals(image, PATCHES[:1])
    assert not normals[:, lost].any()
    around = [np.roll(~lost, (down, across), (0, 1)) for down in (-1, 0, 1) for across in range(-4, 5)]
    few = np.sum(around, axis=0)[1:-1] < PATCHES[0].min_neighbours
    assert not there(normals)[1:-1][few].any()
    assert normals.any()


@pytest.mark.parametrize(("distance_m", "least", "most"), [(1.0, 0.0, 0.0), (8.0, 0.8, 1.0)])
def test_a_patch_as_narrow_as_the_noise_of_ranges_is_no_surface(distance_m, least, most):
    """A wall beside a sensor with 64 rings: at 1 m, pixels lie 1 cm apart and scatter by as much along their rays."""
    directions = rays(64, 720, 0.5)
    image = image_of(directions, plane_ranges(directions, -X, distance_m), noise_m=0.01)
    ahead = (image[3] > 0.0) & (image[3] < 1.2 * distance_m)
    assert least <= there(surface_normals(image, FINE_PATCHES))[ahead].mean() <= most
