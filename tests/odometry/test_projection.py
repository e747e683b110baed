"""Range images against clouds whose pixels are known."""

import math
from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from lidarslam.odometry.images import projection
from lidarslam.odometry.images.projection import ImageGrid
from lidarslam.odometry.training.pairs import mirror, rotate_columns

GRID = ImageGrid(16, 90, math.radians(-15.0), math.radians(15.0))


class Shown(NamedTuple):
    """A projection in the tensors that these tests reckon with: images (1, 4, H, W) and index (1, H, W)."""

    images: Tensor
    index: Tensor


def project(points: Tensor, grid: ImageGrid) -> Shown:
    (found,) = projection.project(points.numpy(), [grid])
    return Shown(torch.from_numpy(found.image)[None], torch.from_numpy(found.index)[None])


def place(points: Tensor, grid: ImageGrid = GRID) -> tuple[Tensor, Tensor]:
    """Continuous row and column of points (N, 3): rows are centred on whole numbers, columns begin at them."""
    x, y, z = points.double().unbind(-1)
    row = (torch.atan2(z, torch.hypot(x, y)) - grid.elevation_low) * grid.rows_per_radian
    return row, torch.atan2(y, x).remainder(2.0 * math.pi) * (grid.columns / (2.0 * math.pi))


def polar(azimuth: Tensor, elevation: Tensor, ranges: Tensor) -> Tensor:
    """Points (N, 3) float64 from angles in degrees and ranges in metres."""
    a, e = azimuth.double().deg2rad(), elevation.double().deg2rad()
    return ranges.double()[:, None] * torch.stack([e.cos() * a.cos(), e.cos() * a.sin(), e.sin()], dim=1)


def one(azimuth: float, elevation: float, distance: float) -> Tensor:
    return polar(torch.tensor([azimuth]), torch.tensor([elevation]), torch.tensor([distance]))


def random_cloud(count: int, seed: int = 0, grid: ImageGrid = GRID) -> Tensor:
    """Points (N, 3) float64 in all pixels of the grid, a twentieth of a pixel or more from their borders."""
    generator = torch.Generator().manual_seed(seed)
    inside = 0.05 + 0.9 * torch.rand(2, count, generator=generator, dtype=torch.float64)
    column = torch.randint(grid.columns, (count,), generator=generator) + inside[0]
    row = torch.randint(grid.rows, (count,), generator=generator) + inside[1] - 0.5
    height = math.degrees(grid.elevation_high - grid.elevation_low)
    elevation = math.degrees(grid.elevation_low) + row * height / (grid.rows - 1)
    ranges = 1.0 + 49.0 * torch.rand(count, generator=generator)
    return polar(column * 360.0 / grid.columns, elevation, ranges)


def turned(points: Tensor, angle: float) -> Tensor:
    cos, sin = math.cos(angle), math.sin(angle)
    return points @ torch.tensor([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]], dtype=points.dtype)


def pixel_of(points: Tensor, grid: ImageGrid = GRID) -> list[tuple[int, int]]:
    """Where points, projected one at a time, appear as (row, column)."""
    found = []
    for point in points:
        filled = project(point[None], grid).index[0].eq(0).nonzero()
        found += [(int(row), int(column)) for row, column in filled]
    return found


def test_a_point_is_in_the_pixel_of_its_angles() -> None:
    # 2 degrees to a row, 4 to a column
    points = torch.cat([one(2.0, -15.0, 5.0), one(6.0, 15.0, 5.0), one(91.0, -0.1, 5.0), one(-1.0, 0.1, 5.0)])
    assert pixel_of(points) == [(0, 0), (15, 1), (7, 22), (8, 89)]


def test_every_pixel_holds_the_nearest_of_a_dense_cloud() -> None:
    points = random_cloud(20_000)
    row, column = place(points, GRID)
    pixel = (row + 0.5).floor().long() * GRID.columns + column.long()
    ranges = points.norm(dim=1).float()
    expected = torch.full((GRID.rows * GRID.columns,), math.inf)
    for cell, distance in zip(pixel.tolist(), ranges.tolist(), strict=True):
        expected[cell] = min(expected[cell], distance)
    result = project(points, GRID)
    assert expected.isfinite().all()
    torch.testing.assert_close(result.images[0, 3].flatten(), expected, rtol=1e-6, atol=0.0)


def test_images_and_index_agree() -> None:
    points = random_cloud(400).float()
    result = project(points, GRID)
    filled = result.index[0] >= 0
    assert 100 < filled.sum() < GRID.rows * GRID.columns - 100
    chosen = points[result.index[0][filled]]
    assert torch.equal(result.images[0, :3, filled].T, chosen)
    torch.testing.assert_close(result.images[0, 3, filled], chosen.norm(dim=1))
    assert torch.equal(result.images[0, :, ~filled], torch.zeros(4, int((~filled).sum())))
    assert result.images.dtype == torch.float32
    assert result.index.dtype == torch.int64


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shift", [1, 30, -7])
def test_a_turn_by_columns_rolls_the_image(shift: int, dtype: torch.dtype) -> None:
    points = random_cloud(5000)
    before = project(points.to(dtype), GRID)
    after = project(turned(points, shift * 2.0 * math.pi / GRID.columns).to(dtype), GRID)
    assert torch.equal(after.index, before.index.roll(shift, dims=2))
    torch.testing.assert_close(rotate_columns(before.images, torch.tensor([shift])), after.images, rtol=1e-5, atol=2e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_columns_are_inside_the_image_however_close_to_the_seam(dtype: torch.dtype) -> None:
    y = torch.tensor([0.0, -0.0, 1e-30, -1e-30, -1e-20, -1e-9, -1e-7, 1e-9], dtype=dtype)
    points = torch.stack([torch.ones_like(y), y, torch.zeros_like(y)], dim=1)
    points = torch.cat([points, points * torch.tensor([-1.0, 1.0, 1.0], dtype=dtype)])
    for columns in (1, 7, 90, 720, 1800, 2083):
        for number, point in enumerate(points):
            ((_, column),) = pixel_of(point[None], ImageGrid(2, columns, -0.2, 0.2))
            assert 0 <= column < columns
            assert column == 0 or number >= 2


def test_invalid_points_are_left_out() -> None:
    nan, inf = math.nan, math.inf
    bad = torch.tensor([[0.0, 0.0, 0.0], [nan, 1.0, 0.0], [1.0, nan, 0.0], [1.0, 0.0, nan], [inf, 0.0, 0.0]])
    bad = torch.cat([bad, torch.tensor([[1.0, -inf, 0.0], [nan, nan, nan], [3e38, 3e38, 0.0]])])
    assert pixel_of(bad) == []
    result = project(torch.cat([bad, torch.tensor([[4.0, 0.1, 0.0]])]), GRID)
    assert result.index[result.index >= 0].tolist() == [len(bad)]
    assert result.images.isfinite().all()


def test_a_grid_around_a_scan_puts_its_rings_in_rows() -> None:
    rings = torch.arange(16).repeat_interleave(100)
    azimuth = torch.arange(100).repeat(16) * 3.6 + 0.1
    points = polar(azimuth, 2.0 * rings - 15.0, torch.full((1600,), 8.0))
    strays = torch.cat([one(10.0, 80.0, 5.0), one(20.0, -70.0, 5.0), torch.tensor([[math.nan] * 3, [0.0] * 3])])
    grid = ImageGrid.around(torch.cat([points, strays]).numpy(), 16, 90)
    assert math.degrees(grid.elevation_low) == pytest.approx(-15.0, abs=1e-9)
    assert math.degrees(grid.elevation_high) == pytest.approx(15.0, abs=1e-9)
    row, _ = place(points, grid)
    np.testing.assert_allclose(row, rings, atol=1e-9)


def test_mirrored_images_are_of_mirrored_clouds() -> None:
    points = random_cloud(3000)
    mirrored = project(points * torch.tensor([1.0, -1.0, 1.0]), GRID)
    before = project(points, GRID)
    assert torch.equal(mirrored.index, before.index.flip(2))
    assert torch.equal(mirror(before.images), mirrored.images)
