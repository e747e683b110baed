"""Normals of range images of surfaces that are known in closed form."""

import math
from collections.abc import Sequence

import numpy as np
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


def test_a_sphere_from_within_gives_its_radii() -> None:
    # Off its centre, so that normals are not merely the rays reversed.
    directions, centre, radius = rays(), torch.tensor([1.0, -0.5, 0.2], dtype=torch.float64)[:, None, None], 6.0
    along = (directions * centre).sum(dim=0)
    ranges = along + (along.square() - centre.square().sum() + radius**2).sqrt()
    truth = (centre - directions * ranges) / radius
    inner = surface_normals(image_of(directions, ranges), CONFIG)[:, :, 1:-1]
    errors = errors_deg(inner, truth[:, 1:-1])
    assert len(errors) == (ROWS - 2) * COLUMNS
    assert errors.max() < 0.2


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


@pytest.mark.parametrize("distance", [0.0, 0.05, 3.0, 80.0])
def test_points_that_are_all_the_same_have_no_normals(distance: float) -> None:
    point = distance * torch.tensor([0.48, 0.64, 0.6])
    image = torch.cat([point, torch.tensor([distance])])[None, :, None, None].repeat(1, 1, 8, 32)
    assert not surface_normals(image, CONFIG).any()
    # and neither have they with the rounding of a transformation
    image[:, :3] *= 1.0 + 1e-7 * torch.randn(1, 3, 8, 32, generator=torch.Generator().manual_seed(0))
    assert not surface_normals(image, CONFIG).any()


def test_walls_a_step_apart_do_not_mix() -> None:
    directions, truth = rays(columns=720), torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64)
    near, far = plane_ranges(directions, truth, 4.0), plane_ranges(directions, truth, 5.0)
    ranges = torch.where(torch.arange(720) < 20, near, far)
    ranges = torch.where(directions[0] > 0.5, ranges, math.inf)
    gated = surface_normals(image_of(directions, ranges), FIRST_TRY)
    assert (gated[0, :, :, 10:30].norm(dim=0) > 0.0).all()
    assert errors_deg(gated, truth[:, None, None]).max() < 0.1
    mixed = surface_normals(image_of(directions, ranges), [PATCHES[0]._replace(gate_m=5.0, max_flatness=1.0)])
    assert errors_deg(mixed, truth[:, None, None]).max() > 10.0


def test_sparse_rows_on_the_ground_get_a_normal_at_the_second_try() -> None:
    truth = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    image = image_of(rays(), plane_ranges(rays(), truth, 1.8))
    first, both = surface_normals(image, FIRST_TRY), surface_normals(image, CONFIG)
    apart_m = image[0, 3].diff(dim=0).amax(dim=1)  # from one ring to the next
    ring = int(((apart_m > 0.5) & (apart_m < 2.0)).nonzero()[-1])
    assert not first[:, :, ring].any()
    assert both[:, :, ring].any(dim=1).all()
    assert errors_deg(both, truth[:, None, None]).max() < 0.1


def test_normals_of_the_first_try_are_kept() -> None:
    image = image_of(rays(), room(rays())[0], 0.01)
    first, both = surface_normals(image, FIRST_TRY), surface_normals(image, CONFIG)
    there = first.any(dim=1, keepdim=True)
    assert torch.equal(both * there, first)
    assert both.any(dim=1).sum() > there.sum()


def test_the_second_try_has_its_own_gate_and_columns() -> None:
    image = image_of(rays(), room(rays())[0], 0.01)
    again = surface_normals(image, [*FIRST_TRY, *FIRST_TRY])
    assert torch.equal(again, surface_normals(image, FIRST_TRY))


@pytest.mark.parametrize("shift", [1, 4, 170])
def test_neighbourhoods_go_on_across_the_seam(shift: int) -> None:
    image = image_of(rays(), room(rays())[0], 0.01)
    rolled = surface_normals(image.roll(shift, dims=3), CONFIG)
    assert torch.equal(rolled, surface_normals(image, CONFIG).roll(shift, dims=3))


def test_the_lowest_and_the_highest_row_are_no_neighbours() -> None:
    # Two rows that would be a plane together, were the image to wrap from top to bottom.
    image = image_of(rays(), torch.full((ROWS, COLUMNS), 5.0, dtype=torch.float64))
    image[:, :, 1:-1] = 0.0
    assert not surface_normals(image, CONFIG).any()
    assert surface_normals(image.roll(1, dims=2), CONFIG)[:, :, :2].any()


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


def test_empty_pixels_are_no_neighbours_of_points_within_the_gate_of_the_origin() -> None:
    truth = torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64)
    image = image_of(rays(), plane_ranges(rays(), truth, 0.3))
    image[:, :, torch.rand(ROWS, COLUMNS, generator=torch.Generator().manual_seed(0)) < 0.3] = 0.0
    errors = errors_deg(surface_normals(image, CONFIG), truth[:, None, None])
    assert len(errors) > 1000
    assert errors.max() < 0.1


@pytest.mark.parametrize("spread", ["near one another", "anywhere"])
def test_normals_of_sparse_points_are_numbers(spread):
    """One or two neighbours have a scatter that rounding may make less than nothing."""
    g = torch.Generator().manual_seed(0)
    azimuth = (torch.arange(180) + 0.5) * (2.0 * math.pi / 180.0)
    elevation = torch.linspace(-0.3, 0.3, 16)[:, None].expand(16, 180)
    rays = torch.stack([elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin()])
    ranges = 0.5 + 0.01 * torch.randn(20, 1, 16, 180, generator=g)
    if spread == "anywhere":
        ranges = 10.0 ** (3.0 * torch.rand(20, 1, 16, 180, generator=g) - 1.0)
    seen = torch.rand(20, 1, 16, 180, generator=g) < 0.15
    normals = surface_normals(torch.cat([rays * ranges, ranges], dim=1) * seen, CONFIG)
    assert normals.isfinite().all()
    length = normals.norm(dim=1)
    assert ((length < 1e-6) | ((length - 1.0).abs() < 1e-4)).all()


def slow_normals(image: Tensor, config: Sequence[Patch]) -> np.ndarray:
    """Normals (H, W, 3) of an image (4, H, W), pixel by pixel, with LAPACK's eigenvectors."""
    values = image.double().numpy()
    _, height, width = values.shape
    found = np.zeros((height, width, 3))
    for patch in config:
        for i, j in np.argwhere(values[3] > 0.0):
            if found[i, j].any():
                continue
            rows = np.arange(max(i - patch.rows, 0), min(i + patch.rows, height - 1) + 1)
            columns = np.arange(j - patch.columns, j + patch.columns + 1) % width
            around = values[:, rows][:, :, columns].reshape(4, -1).T
            near = around[(around[:, 3] > 0.0) & (np.abs(around[:, 3] - values[3, i, j]) <= patch.gate_m), :3]
            apart = np.sort(np.linalg.norm(near - values[:3, i, j], axis=1))
            if len(near) < patch.min_neighbours or apart[1] > patch.nearest_m:
                continue
            spread, axes = np.linalg.eigh((near - near.mean(axis=0)).T @ (near - near.mean(axis=0)))
            away = axes[:, 0] @ values[:3, i, j]
            is_plane = spread[0] <= patch.max_flatness * spread[1] and spread[1] >= patch.min_spread * spread[2]
            if is_plane and abs(away) >= 0.04 * values[3, i, j]:
                found[i, j] = -np.sign(away) * axes[:, 0]
    return found


@pytest.mark.parametrize("config", [CONFIG, FIRST_TRY, FINE_PATCHES])
@pytest.mark.parametrize("noise_m", [0.01, 0.03])
def test_the_compiled_loops_find_what_lapack_finds(config: Sequence[Patch], noise_m: float) -> None:
    """Where a neighbourhood is just a plane, rounding decides."""
    image = image_of(rays(columns=180), room(rays(columns=180))[0], noise_m)
    image[..., ::7, 20:60] = 0.0
    found, expected = surface_normals(image, config)[0].double().movedim(0, -1).numpy(), slow_normals(image[0], config)
    there, also = found.any(axis=-1), expected.any(axis=-1)
    assert there.mean() > 0.3
    assert (there != also).mean() < 2e-3
    cosine = (found * expected).sum(axis=-1)[there & also]
    assert (cosine < 1.0 - 1e-4).mean() < 1e-3
    assert not found[image[0, 3].numpy() == 0.0].any()


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
