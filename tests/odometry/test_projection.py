"""Range images against clouds whose pixels are known."""

import math

import numpy as np
import pytest
import torch
from numpy.typing import ArrayLike

from lidarslam.core.geometry import FloatArray
from lidarslam.odometry.images import projection
from lidarslam.odometry.images.projection import ImageGrid, Points, Projection
from lidarslam.odometry.training.pairs import mirror, rotate_columns

GRID = ImageGrid(16, 90, math.radians(-15.0), math.radians(15.0))


def project(points: Points, grid: ImageGrid = GRID) -> Projection:
    return projection.project(points, [grid])[0]


def place(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Continuous row and column of points (N, 3): rows are centred on whole numbers, columns begin at them."""
    x, y, z = points.T
    row = (np.arctan2(z, np.hypot(x, y)) - GRID.elevation_low) * GRID.rows_per_radian
    return row, np.arctan2(y, x) % (2.0 * np.pi) * (GRID.columns / (2.0 * np.pi))


def polar(azimuth_deg: ArrayLike, elevation_deg: ArrayLike, ranges: ArrayLike) -> FloatArray:
    """Points (N, 3)."""
    a, e, r = np.broadcast_arrays(np.deg2rad(azimuth_deg), np.deg2rad(elevation_deg), ranges)
    return np.stack([r * np.cos(e) * np.cos(a), r * np.cos(e) * np.sin(a), r * np.sin(e)], axis=-1).reshape(-1, 3)


def random_cloud(count: int) -> FloatArray:
    """Points (N, 3) in all pixels of the grid, a twentieth of a pixel or more from their borders."""
    rng = np.random.default_rng(0)
    column = rng.integers(GRID.columns, size=count) + rng.uniform(0.05, 0.95, count)
    row = rng.integers(GRID.rows, size=count) + rng.uniform(-0.45, 0.45, count)
    elevation = GRID.elevation_low + row / GRID.rows_per_radian
    return polar(column * 360.0 / GRID.columns, np.rad2deg(elevation), rng.uniform(1.0, 50.0, count))


def pixel_of(points: Points, grid: ImageGrid = GRID) -> list[tuple[int, ...]]:
    """Where points, projected one at a time, appear as (row, column)."""
    return [tuple(pixel) for one in points for pixel in np.argwhere(project(one[None], grid).index == 0).tolist()]


@pytest.mark.parametrize(("count", "least", "most"), [(400, 100, 1340), (20_000, 1440, 1440)])
def test_pixels_hold_the_nearest_point_and_its_index(count, least, most):
    points = random_cloud(count).astype(np.float32)
    row, column = place(points)
    expected = np.full((GRID.rows, GRID.columns), np.inf)
    np.minimum.at(expected, (np.floor(row + 0.5).astype(int), column.astype(int)), np.linalg.norm(points, axis=1))
    found, filled = project(points), np.isfinite(expected)
    assert least <= filled.sum() <= most
    np.testing.assert_allclose(found.image[3, filled], expected[filled], rtol=1e-6)
    np.testing.assert_array_equal(found.image[:3, filled].T, points[found.index[filled]])
    assert (found.index[~filled] == -1).all()
    assert not found.image[:, ~filled].any()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("shift", [1, 30, -7])
def test_a_turn_by_columns_rolls_the_image(shift, dtype):
    points, angle = random_cloud(5000), shift * 2.0 * math.pi / GRID.columns
    turn = np.array(
        [[math.cos(angle), math.sin(angle), 0.0], [-math.sin(angle), math.cos(angle), 0.0], [0.0, 0.0, 1.0]]
    )
    before, after = project(points.astype(dtype)), project((points @ turn).astype(dtype))
    np.testing.assert_array_equal(after.index, np.roll(before.index, shift, axis=1))
    rolled = rotate_columns(torch.from_numpy(before.image)[None], torch.tensor([shift]))[0]
    np.testing.assert_allclose(rolled, after.image, rtol=1e-5, atol=2e-5)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_columns_are_inside_the_image_however_close_to_the_seam(dtype):
    y = np.array([0.0, -0.0, 1e-30, -1e-30, -1e-20, -1e-9, -1e-7, 1e-9], dtype=dtype)
    points = np.stack([np.ones_like(y), y, np.zeros_like(y)], axis=1)
    points = np.concatenate([points, points * np.array([-1.0, 1.0, 1.0], dtype=dtype)])
    for columns in (1, 7, 90, 720, 1800, 2083):
        for number, (_, column) in enumerate(pixel_of(points, ImageGrid(2, columns, -0.2, 0.2))):
            assert 0 <= column < columns
            assert column == 0 or number >= 2


def test_invalid_points_are_left_out():
    nan, inf = math.nan, math.inf
    bad = np.array([
        [0.0, 0.0, 0.0], [nan, 1.0, 0.0], [1.0, nan, 0.0], [1.0, 0.0, nan], [inf, 0.0, 0.0], [1.0, -inf, 0.0],
        [nan, nan, nan], [3e38, 3e38, 0.0],
    ])  # fmt: skip
    assert pixel_of(bad) == []
    found = project(np.concatenate([bad, [[4.0, 0.1, 0.0]]]))
    assert found.index[found.index >= 0].tolist() == [len(bad)]
    assert np.isfinite(found.image).all()


def test_a_grid_around_a_scan_puts_its_rings_in_rows():
    rings = np.repeat(np.arange(16), 100)
    points = polar(np.tile(np.arange(100), 16) * 3.6 + 0.1, 2.0 * rings - 15.0, 8.0)
    strays = [*polar([10.0, 20.0], [80.0, -70.0], 5.0), [math.nan] * 3, [0.0] * 3]
    grid = ImageGrid.around(np.concatenate([points, strays]), 16, 90)
    assert np.rad2deg([grid.elevation_low, grid.elevation_high]) == pytest.approx([-15.0, 15.0], abs=1e-9)
    np.testing.assert_allclose(place(points)[0], rings, atol=1e-9)


def test_mirrored_images_are_of_mirrored_clouds():
    points = random_cloud(3000)
    before, mirrored = project(points), project(points * [1.0, -1.0, 1.0])
    np.testing.assert_array_equal(mirrored.index, before.index[:, ::-1])
    np.testing.assert_array_equal(mirror(torch.from_numpy(before.image)).numpy(), mirrored.image)
