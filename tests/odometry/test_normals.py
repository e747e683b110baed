"""Normals of range images of surfaces that are known in closed form."""

import math
from collections.abc import Sequence

import pytest
import torch
from torch import Tensor

from lidarslam.odometry.images.normals import FINE_PATCHES, PATCHES, Patch
from lidarslam.odometry.images.normals import surface_normals as normals_of

CONFIG = PATCHES
FIRST_TRY = PATCHES[:1]
ROWS, COLUMNS = 16, 360


def surface_normals(images: Tensor, config: Sequence[Patch]) -> Tensor:
    """Normals (B, 3, H, W) of images (B, 4, H, W), in the tensors that these tests reckon with."""
    return torch.stack([torch.from_numpy(normals_of(image.numpy(), config)) for image in images])


def rays(rows: int = ROWS, columns: int = COLUMNS, step_deg: float = 2.0) -> Tensor:
    """Directions (3, H, W) through the centres of pixels, float64, about the horizon."""
    elevation = torch.deg2rad((torch.arange(rows, dtype=torch.float64) - (rows - 1) / 2.0) * step_deg)[:, None]
    azimuth = (torch.arange(columns, dtype=torch.float64) + 0.5) * (2.0 * math.pi / columns)
    flat = elevation.cos().expand(rows, columns)
    return torch.stack([flat * azimuth.cos(), flat * azimuth.sin(), elevation.sin().expand(rows, columns)])


def image_of(directions: Tensor, ranges: Tensor, noise_m: float = 0.0) -> Tensor:
    """The image (1, 4, H, W) of ranges (H, W) along rays; where infinite or negative it is empty."""
    noise = torch.randn(ranges.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    seen = ranges.isfinite() & (ranges > 0.0)
    measured = torch.where(seen, ranges + noise_m * noise, 0.0)
    return torch.cat([directions * measured, measured[None]])[None].float()


def plane_ranges(directions: Tensor, normal: Tensor, distance: float) -> Tensor:
    """Ranges to the plane that unit `normal` faces the sensor from, at this distance; cut off at 40 m."""
    ranges = distance / -(directions * normal[:, None, None]).sum(dim=0)
    return torch.where((ranges > 0.0) & (ranges < 40.0), ranges, math.inf)


def room(directions: Tensor) -> tuple[Tensor, Tensor]:
    """Ranges (H, W) in a room of 12 x 8 x 3 m, seen from its middle, and true normals (3, H, W)."""
    half = torch.tensor([6.0, 4.0, 1.5], dtype=torch.float64)[:, None, None]
    ranges, wall = (half / directions.abs()).min(dim=0)
    normals = torch.zeros_like(directions).scatter(0, wall[None], 1.0)
    return ranges, -normals * directions.sign()


def errors_deg(normals: Tensor, truth: Tensor) -> Tensor:
    """Angles (K,) between normals (1, 3, H, W), where there are any, and the true ones (3, H, W)."""
    there = normals[0].norm(dim=0) > 0.0
    estimated, expected = normals[0].double()[:, there], truth.expand(normals.shape[1:])[:, there]
    cross = torch.linalg.cross(estimated, expected, dim=0).norm(dim=0)
    return torch.rad2deg(torch.atan2(cross, (estimated * expected).sum(dim=0)))


@pytest.mark.parametrize(
    ("normal", "distance", "least_share"),
    [
        ([0.0, 0.0, 1.0], 0.5, 0.5),  # floor
        ([-1.0, 0.0, 0.0], 5.0, 0.8),  # wall across the seam
        ([0.0, 1.0, 0.0], 2.0, 0.7),  # wall to the right
        ([-0.6, -0.64, 0.48], 4.0, 0.7),  # slope
    ],
)
@pytest.mark.parametrize(("noise_m", "median_deg", "worst_deg"), [(0.0, 0.01, 0.1), (0.01, 4.0, 25.0)])
def test_a_plane_gives_its_normal(
    normal: list[float], distance: float, least_share: float, noise_m: float, median_deg: float, worst_deg: float
) -> None:
    truth = torch.tensor(normal, dtype=torch.float64)
    image = image_of(rays(), plane_ranges(rays(), truth, distance), noise_m)
    normals = surface_normals(image, CONFIG)
    near = (image[0, 3] > 0.0) & (image[0, 3] < 4.0 * distance)
    assert (normals[0].norm(dim=0) > 0.0)[near].float().mean() > least_share
    errors = errors_deg(normals, truth[:, None, None])
    assert errors.median() < median_deg
    assert errors.max() < worst_deg


@pytest.mark.parametrize("noise_m", [0.0, 0.01, 0.03])
def test_normals_are_unit_or_zero_and_face_the_sensor(noise_m: float) -> None:
    image = image_of(rays(), room(rays())[0], noise_m)
    normals = surface_normals(image, CONFIG)
    there = normals[0].norm(dim=0) > 0.0
    assert there.float().mean() > 0.7
    torch.testing.assert_close(normals[0].norm(dim=0), there.float(), rtol=0.0, atol=1e-5)
    assert ((normals * image[:, :3]).sum(dim=1)[0][there] < 0.0).all()
    assert normals.dtype == torch.float32


@pytest.mark.parametrize(
    ("noise_m", "median_deg", "wrong_share"), [(0.0, 0.01, 0.1), (0.01, 2.0, 0.1), (0.03, 5.0, 0.2)]
)
def test_few_normals_in_a_room_are_wrong(noise_m: float, median_deg: float, wrong_share: float) -> None:
    directions = rays(columns=720)
    ranges, truth = room(directions)
    normals = surface_normals(image_of(directions, ranges, noise_m), CONFIG)
    errors = errors_deg(normals, truth)
    assert len(errors) > 0.8 * ROWS * 720
    assert errors.median() < median_deg
    assert (errors > 10.0).float().mean() < wrong_share
    assert errors.max() < 90.0


def test_edges_are_left_out_where_the_neighbourhood_is_no_plane() -> None:
    # In a corner of 90 degrees, 6 degrees wide, hardly any patch may pass for a plane that is neither wall.
    directions = rays(columns=720)
    normal_x, normal_y = torch.eye(3, dtype=torch.float64)[:2].neg()
    ranges = torch.minimum(plane_ranges(directions, normal_x, 4.0), plane_ranges(directions, normal_y, 4.0))
    image = image_of(directions, ranges)
    edge = slice(720 // 8 - 2, 720 // 8 + 2)
    corner = surface_normals(image, CONFIG)[0, :, :, edge].norm(dim=0)
    lenient = surface_normals(image, [patch._replace(max_flatness=1.0) for patch in PATCHES])[0, :, :, edge].norm(dim=0)
    assert (corner > 0.0).float().mean() < 0.1
    assert (lenient > 0.0).float().mean() > 0.8


@pytest.mark.parametrize("noise_m", [0.0, 0.01, 0.03])
def test_one_ring_has_no_normals(noise_m: float) -> None:
    directions = rays()
    wall = plane_ranges(directions, torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64), 5.0)
    floor = plane_ranges(directions, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), 1.0)
    for ranges, ring in ((wall, 5), (wall, 7), (floor, 2)):
        alone = torch.full_like(ranges, math.inf)
        alone[ring] = ranges[ring]
        image = image_of(directions, alone, noise_m)
        assert (image[0, 3] > 0.0).sum() > 100
        assert not surface_normals(image, CONFIG).any()


def test_sparse_rows_on_the_ground_get_a_normal_at_the_second_try() -> None:
    truth = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    image = image_of(rays(), plane_ranges(rays(), truth, 1.8))
    first, both = surface_normals(image, FIRST_TRY), surface_normals(image, CONFIG)
    apart_m = image[0, 3].diff(dim=0).amax(dim=1)  # from one ring to the next
    ring = int(((apart_m > 0.5) & (apart_m < 2.0)).nonzero()[-1])
    assert not first[:, :, ring].any()
    assert both[:, :, ring].any(dim=1).all()
    assert errors_deg(both, truth[:, None, None]).max() < 0.1


def test_empty_pixels_have_no_normals_and_too_few_neighbours_neither() -> None:
    image = image_of(rays(), room(rays())[0])
    lost = torch.rand(ROWS, COLUMNS, generator=torch.Generator().manual_seed(0)) < 0.7
    image[:, :, lost] = 0.0
    normals = surface_normals(image, FIRST_TRY)
    assert not normals[:, :, lost].any()
    counts = torch.nn.functional.avg_pool2d(
        torch.nn.functional.pad((~lost).float()[None], (4, 4, 0, 0), mode="circular"), (3, 9), 1, divisor_override=1
    )
    assert not normals[0, :, 1:-1].norm(dim=0)[counts[0] < FIRST_TRY[0].min_neighbours].any()
    assert normals.any()


@pytest.mark.parametrize(("distance_m", "share"), [(1.0, 0.0), (8.0, 0.8)])
def test_a_patch_as_narrow_as_the_noise_of_ranges_is_no_surface(distance_m, share):
    """A wall beside a sensor with 64 rings: at 1 m, pixels lie 1 cm apart and scatter by as much along their rays."""
    directions = rays(64, 720, 0.5)
    wall = torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64)
    image = image_of(directions, plane_ranges(directions, wall, distance_m), noise_m=0.01)
    there = surface_normals(image, FINE_PATCHES).norm(dim=1) > 0.0
    ahead = (image[0, 3] > 0.0) & (image[0, 3] < 1.2 * distance_m)
    found = float(there[0][ahead].float().mean())
    assert found == 0.0 if share == 0.0 else found > share
