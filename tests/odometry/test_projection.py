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


def test_the_nearest_point_is_kept() -> None:
    points = torch.cat([one(2.0, 1.0, 7.0), one(2.1, 1.1, 3.0), one(2.2, 1.2, 3.001)])
    result = project(points, GRID)
    assert result.index[0, 8, 0] == 1
    assert (result.index >= 0).sum() == 1
    torch.testing.assert_close(result.images[0, :3, 8, 0], points[1].float())
    assert result.images[0, 3, 8, 0] == pytest.approx(3.0, rel=1e-6)


def test_of_equally_near_points_the_first_is_kept() -> None:
    assert project(one(2.0, 1.0, 7.0).repeat(5, 1), GRID).index.max() == 0


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


def test_the_order_of_points_does_not_matter() -> None:
    points = random_cloud(5000)
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(1))
    assert torch.equal(project(points, GRID).images, project(points[order], GRID).images)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shift", [1, 30, -7])
def test_a_turn_by_columns_rolls_the_image(shift: int, dtype: torch.dtype) -> None:
    points = random_cloud(5000)
    before = project(points.to(dtype), GRID)
    after = project(turned(points, shift * 2.0 * math.pi / GRID.columns).to(dtype), GRID)
    assert torch.equal(after.index, before.index.roll(shift, dims=2))
    torch.testing.assert_close(rotate_columns(before.images, torch.tensor([shift])), after.images, rtol=1e-5, atol=2e-5)


def test_the_image_has_no_seam() -> None:
    tiny = 1e-4
    points = torch.cat(
        [one(tiny, 0.5, 9.0), one(-tiny, 0.5, 9.0), one(180 - tiny, 0.5, 9.0), one(180 + tiny, 0.5, 9.0)]
    )
    assert pixel_of(points) == [(8, 0), (8, 89), (8, 44), (8, 45)]


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


def test_points_above_and_below_are_left_out() -> None:
    elevations = torch.tensor([-16.01, -15.99, 15.99, 16.01, 90.0, -90.0])
    points = polar(torch.full((6,), 2.0), elevations, torch.full((6,), 5.0))
    assert pixel_of(points) == [(0, 0), (15, 0)]


def test_invalid_points_are_left_out() -> None:
    nan, inf = math.nan, math.inf
    bad = torch.tensor([[0.0, 0.0, 0.0], [nan, 1.0, 0.0], [1.0, nan, 0.0], [1.0, 0.0, nan], [inf, 0.0, 0.0]])
    bad = torch.cat([bad, torch.tensor([[1.0, -inf, 0.0], [nan, nan, nan], [3e38, 3e38, 0.0]])])
    assert pixel_of(bad) == []
    result = project(torch.cat([bad, torch.tensor([[4.0, 0.1, 0.0]])]), GRID)
    assert result.index[result.index >= 0].tolist() == [len(bad)]
    assert result.images.isfinite().all()


@pytest.mark.parametrize("point", [[4.0, 0.0, 0.5], [0.0, 4.0, 0.5], [4.0, 1.0, 0.0], [-4.0, 0.0, 0.0]])
def test_a_point_with_a_coordinate_of_zero_stays(point: list[float]) -> None:
    assert len(pixel_of(torch.tensor([point]))) == 1


def test_no_points_give_empty_images() -> None:
    result = project(torch.empty(0, 3), GRID)
    assert torch.equal(result.images, torch.zeros(1, 4, 16, 90))
    assert torch.equal(result.index, torch.full((1, 16, 90), -1))


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


@pytest.mark.parametrize("count", [0, 1, 2, 50])
def test_a_grid_around_few_points_holds_them(count: int) -> None:
    # A single ring with noise, which must not be spread over many rows.
    elevation = 3.0 + 1e-3 * torch.randn(count, generator=torch.Generator().manual_seed(0))
    points = polar(7.0 * torch.arange(count) + 2.0, elevation, torch.full((count,), 5.0))
    grid = ImageGrid.around(points.numpy(), 8, 90)
    assert math.degrees(grid.elevation_high - grid.elevation_low) >= 1.0 - 1e-9
    result = project(points, grid)
    assert (result.index[0, 0] >= 0).sum() == min(count, 50)
    assert (result.index[0, 1:] == -1).all()


def test_grids_without_pixels_or_height_are_refused() -> None:
    with pytest.raises(ValueError, match="pixels"):
        ImageGrid(0, 90, -0.1, 0.1)
    with pytest.raises(ValueError, match="ascend"):
        ImageGrid(16, 90, 0.1, 0.1)


def test_each_image_is_rotated_by_its_own_shift() -> None:
    shifts = [0, 1, -3, 200]
    clouds = [random_cloud(400, seed) for seed in range(4)]
    before = torch.cat([project(cloud, GRID).images for cloud in clouds])
    step = 2.0 * math.pi / GRID.columns
    after = [project(turned(cloud, s * step), GRID).images for cloud, s in zip(clouds, shifts, strict=True)]
    rotated = rotate_columns(before, torch.tensor(shifts))
    torch.testing.assert_close(rotated, torch.cat(after), rtol=1e-5, atol=2e-5)
    assert torch.equal(rotated[0], before[0])


def test_rotation_takes_images_of_normals_too() -> None:
    normals = torch.randn(2, 3, 4, 12, generator=torch.Generator().manual_seed(0))
    quarter = rotate_columns(normals, torch.tensor([3, 3]))
    moved = normals.roll(3, dims=3)
    expected = torch.stack([-moved[:, 1], moved[:, 0], moved[:, 2]], dim=1)
    torch.testing.assert_close(quarter, expected, rtol=0.0, atol=1e-6)


def test_mirrored_images_are_of_mirrored_clouds() -> None:
    points = random_cloud(3000)
    mirrored = project(points * torch.tensor([1.0, -1.0, 1.0]), GRID)
    before = project(points, GRID)
    assert torch.equal(mirrored.index, before.index.flip(2))
    assert torch.equal(mirror(before.images), mirrored.images)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_two_images_made_in_one_go_are_those_made_one_by_one(dtype: torch.dtype) -> None:
    points, fine = random_cloud(5000).to(dtype).numpy(), ImageGrid(40, 90, GRID.elevation_low, GRID.elevation_high)
    for found, grid in zip(projection.project(points, [GRID, fine]), (GRID, fine), strict=True):
        (alone,) = projection.project(points, [grid])
        assert np.array_equal(found.index, alone.index)
        assert np.array_equal(found.image, alone.image)
