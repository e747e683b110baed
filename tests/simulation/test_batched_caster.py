"""The batched caster against formulas and against the mesh caster."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from lidarslam.core.geometry import FloatArray, make_transform
from lidarslam.simulation.batched_caster import BatchedCaster
from lidarslam.simulation.batched_sweep import SweepGrid, with_range_noise
from lidarslam.simulation.batched_world import BatchedWorld
from lidarslam.simulation.caster import Caster
from lidarslam.simulation.mesh import CYLINDER_SIDES
from lidarslam.simulation.scan_patterns import directions
from lidarslam.simulation.sensors import find_sensor
from lidarslam.simulation.world import Boxes, Cylinders, HeightField, Route, World
from lidarslam.simulation.worlds.registry import build_world

MAX_RANGE_M = 100.0
TRIANGLE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def make_world(boxes=None, cylinders=None, fields=()) -> World:
    route = Route(TRIANGLE, 0.0, 1.0, 1.0, 1.0)
    return World("test", 0, route, boxes or Boxes.empty(), cylinders or Cylinders.empty(), fields)


def turn(roll: float, pitch: float, yaw: float) -> FloatArray:
    def about(axis: int, angle: float) -> FloatArray:
        R = np.eye(3)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        R[[i, j], [i, j]] = np.cos(angle)
        R[i, j], R[j, i] = -np.sin(angle), np.sin(angle)
        return R

    return about(2, yaw) @ about(1, pitch) @ about(0, roll)


def all_around(rows: int = 12, columns: int = 60) -> FloatArray:
    """(rows * columns, 3) unit vectors into nearly every direction."""
    azimuth, elevation = np.meshgrid(np.linspace(-3.1, 3.1, columns), np.linspace(-1.5, 1.5, rows))
    return directions(azimuth.ravel(), elevation.ravel())


def ranges_from(world: World, position, rays: FloatArray, **options) -> FloatArray:
    """Ranges (N,) of one image's rays (N, 3), axes of the world."""
    caster = BatchedCaster(BatchedWorld.from_world(world), MAX_RANGE_M, **options)
    T_world_lidar = torch.tensor(make_transform(np.eye(3), np.array(position, dtype=float)))[None]
    return caster.ranges(T_world_lidar, torch.tensor(rays, dtype=torch.float32))[0].double().numpy()


def poses_on_route(world: World, count: int, height_m: float = 1.7) -> FloatArray:
    """(count, 4, 4) tilted sensors above corners of the route."""
    corners = world.route.waypoints[np.linspace(0, len(world.route.waypoints) - 1, count).astype(int)]
    R = np.stack([turn(0.03 * k, -0.05, 1.1 * k) for k in range(count)])
    return make_transform(R, corners + np.array([0.0, 0.0, height_m]))


def share_that_agrees(world: World, grid: SweepGrid, T_world_lidar: FloatArray, times: FloatArray) -> float:
    """Of the rays, whose ranges by both casters are within 2 mm and what the corners of the meshes' cylinders make.

    The corners stand 0.6 % of the radius proud and the sides are 0.3 % inside, less than the height
    r (1 - cos(pi / 24)) of a side's arc; along the ray it is that over the cosine of incidence.
    """
    images = BatchedCaster(BatchedWorld.from_world(world), MAX_RANGE_M).images(
        torch.tensor(T_world_lidar), grid, torch.tensor(times)
    )
    rays = grid.directions.flatten(0, 1).double().numpy()
    mesh_caster = Caster(world)
    first_side, radii = 12 * len(world.boxes), world.cylinders.radii
    agree = []
    for image, T, time in zip(images, T_world_lidar, times, strict=True):
        in_world = rays @ T[:3, :3].T
        origins = np.broadcast_to(T[:3, 3], rays.shape)
        hits = mesh_caster.cast(origins, in_world, np.full(len(rays), time), MAX_RANGE_M)
        cylinder = (hits.surfaces - first_side) // (4 * CYLINDER_SIDES)
        is_round = (hits.surfaces >= first_side) & (cylinder < len(radii))
        allowed = np.full(len(rays), 2e-3)
        arc = radii[cylinder[is_round]] * (1.0 - np.cos(np.pi / CYLINDER_SIDES))
        allowed[is_round] += arc / np.maximum(hits.cosines[is_round], 0.05)
        expected = np.where(np.isfinite(hits.ranges), hits.ranges, 0.0)
        agree.append(np.abs(image[3].flatten().double().numpy() - expected) <= allowed)
    return float(np.mean(agree))


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Arrays this small are slower on several threads when the machine has other work."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def grid() -> SweepGrid:
    return SweepGrid.of_sensor(find_sensor("vlp-16"), columns=360)


@pytest.fixture(scope="module")
def tilted_poles() -> World:
    """Boxes and cylinders in all directions, no ground."""
    rng = np.random.default_rng(0)
    centres, starts = rng.uniform(-20.0, 20.0, (2, 60, 3))
    R = np.stack([turn(*angles) for angles in rng.uniform(-3.0, 3.0, (60, 3))])
    boxes = Boxes(centres, rng.uniform(0.05, 2.0, (60, 3)), R)
    return make_world(boxes, Cylinders(starts, starts + rng.normal(0.0, 3.0, (60, 3)), rng.uniform(0.05, 0.6, 60)))


@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (0.4, -0.9, 2.0)])
def test_the_walls_of_a_box_from_within(angles):
    R, half_sizes = turn(*angles), np.array([7.0, 4.0, 2.5])
    world = make_world(Boxes(np.array([[900.0, -400.0, 30.0]]), half_sizes[None], R[None]))
    rays = all_around()
    inside = np.array([3.0, -1.0, 0.5])
    in_box = rays @ R
    expected = ((half_sizes * np.sign(in_box) - inside) / in_box).min(axis=1)
    position = np.array([900.0, -400.0, 30.0]) + R @ inside
    np.testing.assert_allclose(ranges_from(world, position, rays), expected, atol=2e-5)


def test_a_box_from_outside_and_beyond_the_range():
    world = make_world(Boxes(np.array([[50.0, 0.0, 0.0]]), np.full((1, 3), 2.0), np.eye(3)[None]))
    rays = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    np.testing.assert_allclose(ranges_from(world, [0.0, 0.0, 0.0], rays), [48.0, np.inf, np.inf])
    assert np.isinf(ranges_from(world, [-60.0, 0.0, 0.0], rays)).all()


def test_a_cylinders_side_and_ends():
    lying = Cylinders(np.array([[10.0, -3.0, 1.0]]), np.array([[10.0, 3.0, 1.0]]), np.array([0.5]))
    world = make_world(cylinders=lying)
    height, slant = 0.3, np.hypot(10.0, 4.0)
    rays = np.array(
        [
            [1.0, 0.0, 0.0],  # across, 0.3 m above the axis
            [10.0 / slant, 0.0, 4.0 / slant],  # over it
        ]
    )
    side = 10.0 - np.sqrt(0.5**2 - height**2)
    np.testing.assert_allclose(ranges_from(world, [0.0, 0.0, 1.0 + height], rays), [side, np.inf], atol=1e-5)
    along = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    np.testing.assert_allclose(ranges_from(world, [10.2, -8.0, 1.1], along), [5.0, np.inf], atol=1e-5)
    assert np.isinf(ranges_from(world, [10.6, -8.0, 1.1], along)).all()
    np.testing.assert_allclose(ranges_from(world, [10.2, 1.0, 1.1], along), [2.0, 4.0], atol=1e-5)


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.3, -0.1), (-2.0, 0.5)])
@pytest.mark.parametrize("above", [1.7, -2.0])
def test_a_plane_height_field(slope, above):
    i, j = np.meshgrid(np.arange(161), np.arange(121), indexing="ij")
    origin, cell, slopes = np.array([-40.0, -30.0]), 0.5, np.array(slope)
    plane = HeightField(origin, cell, slopes[0] * (origin[0] + cell * i) + slopes[1] * (origin[1] + cell * j) + 5.0)
    rays = np.concatenate([all_around(), [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
    position = np.array([1.23, 2.34, 0.0])
    position[2] = position[:2] @ slopes + 5.0 + above
    closing = rays[:, :2] @ slopes - rays[:, 2]
    expected = np.divide(above, closing, out=np.full(len(rays), 1e6), where=above * closing > 1e-9)
    within = np.abs(position[:2] + expected[:, None] * rays[:, :2]) < [40.0, 30.0]
    ranges = ranges_from(make_world(fields=(plane,)), position, rays)
    expected = np.where(within.all(axis=1) & (expected <= MAX_RANGE_M), expected, np.inf)
    assert np.isfinite(expected).sum() > 100
    np.testing.assert_allclose(ranges, expected, rtol=1e-4, atol=1e-4)


def test_a_rough_height_field_is_the_very_triangles_of_the_mesh():
    heights = np.random.default_rng(3).normal(0.0, 1.0, (70, 45))
    rough = make_world(fields=(HeightField(np.array([-7.0, -4.0]), 0.2, heights),))
    rays = all_around(40, 200)
    position = np.array([0.013, 0.027, 2.5])
    expected = Caster(rough).cast(np.broadcast_to(position, rays.shape), rays, np.zeros(len(rays)), MAX_RANGE_M)
    cast, from_mesh = (np.minimum(ranges, 1e6) for ranges in (ranges_from(rough, position, rays), expected.ranges))
    assert np.isfinite(expected.ranges).mean() > 0.4
    # Where a ray passes an edge within rounding either answer is right.
    assert (np.abs(cast - from_mesh) < 1e-3).mean() > 0.999


def test_what_is_culled_is_not_met(tilted_poles):
    rays = all_around(50, 180)
    rng = np.random.default_rng(1)
    scattered = rays[rng.permutation(len(rays))]  # tiles as wide as they can be, where nothing is culled
    order = np.lexsort(scattered.T)
    cast = ranges_from(tilted_poles, [1.0, 2.0, 3.0], rays)
    again = ranges_from(tilted_poles, [1.0, 2.0, 3.0], scattered)
    assert np.isfinite(cast).mean() > 0.1
    np.testing.assert_allclose(cast[np.lexsort(rays.T)], again[order], atol=1e-5)


def test_the_yard_with_its_car_agrees_with_the_mesh_caster(yard, grid):
    times = np.array([0.0, 3.0, 900.0, 1234.5])
    assert share_that_agrees(yard, grid, poses_on_route(yard, 4), times) > 0.998


@pytest.mark.parametrize("name", ["street", "tunnel", "hall", "forest"])
def test_real_worlds_agree_with_the_mesh_caster(name, grid):
    world = build_world(name, 1)
    assert share_that_agrees(world, grid, poses_on_route(world, 3), np.array([0.0, 2.0, 40.0])) > 0.995


def test_the_car_is_somewhere_else_later(yard, grid):
    caster = BatchedCaster(BatchedWorld.from_world(yard), MAX_RANGE_M)
    poses = torch.tensor(poses_on_route(yard, 1)).expand(2, -1, -1)
    early, late = caster.images(poses, grid, torch.tensor([0.0, 3.0]))
    assert ((early - late)[3].abs() > 1.0).sum() > 20


def test_a_batch_of_two_worlds_is_the_two_alone(yard, tilted_poles, grid):
    poses = torch.tensor(np.concatenate([poses_on_route(yard, 2), poses_on_route(tilted_poles, 1)]))
    times = torch.tensor([1.0, 2.0, 3.0])
    both = BatchedCaster(BatchedWorld.from_worlds([yard, tilted_poles]), MAX_RANGE_M)
    together = both.images(poses, grid, times, worlds=torch.tensor([0, 0, 1]))
    alone = [
        BatchedCaster(BatchedWorld.from_world(world), MAX_RANGE_M).images(poses[part], grid, times[part])
        for world, part in ((yard, slice(0, 2)), (tilted_poles, slice(2, 3)))
    ]
    assert together.shape == (3, 4, 16, 360)
    torch.testing.assert_close(together, torch.cat(alone), rtol=0.0, atol=1e-5)
    with pytest.raises(ValueError, match="3 images in 2 worlds"):
        both.images(poses, grid)


def test_a_rolling_sweep_is_its_columns_cast_alone(yard, grid):
    part = SweepGrid(grid.directions[:, ::20].contiguous(), grid.fractions[::20])
    columns = len(part.fractions)
    T_start = poses_on_route(yard, 1)[0]
    way = np.linspace(0.0, 2.0, columns)[:, None] * [1.0, 0.3, 0.1]
    moves = make_transform(np.stack([turn(0.0, 0.0, 0.02 * k) for k in range(columns)]), way)
    poses, times = torch.tensor(T_start @ moves), 0.1 * part.fractions
    caster = BatchedCaster(BatchedWorld.from_world(yard), MAX_RANGE_M)
    rolling = caster.images(poses[None], part, times[None])[0]
    for k in range(columns):
        column = caster.ranges(poses[k, None], part.directions[:, k], times[k, None])[0]
        column = torch.where(column.isfinite(), column, 0.0)
        torch.testing.assert_close(rolling[3, :, k], column, rtol=0.0, atol=2e-4)


def test_memory_bounds_change_nothing(yard, grid):
    poses, world = torch.tensor(poses_on_route(yard, 3)), BatchedWorld.from_world(yard)
    images = BatchedCaster(world, MAX_RANGE_M).images(poses, grid)
    torch.testing.assert_close(
        BatchedCaster(world, MAX_RANGE_M, comparisons=1000).images(poses, grid), images, rtol=0.0, atol=1e-5
    )


def test_images_have_a_row_a_ring_and_a_column_a_shot(yard):
    sensor = find_sensor("hdl-32e")
    grid = SweepGrid.of_sensor(sensor)
    rays = sensor.rays(0)
    assert grid.directions.shape == (sensor.pattern.lasers, sensor.pattern.columns, 3)
    shot = np.arange(len(rays.rings)) // sensor.pattern.lasers
    np.testing.assert_allclose(grid.directions[rays.rings, shot], rays.directions, atol=1e-6)
    image = BatchedCaster(BatchedWorld.from_world(yard), MAX_RANGE_M).images(
        torch.tensor(poses_on_route(yard, 1)), grid
    )[0]
    torch.testing.assert_close(image[:3].norm(dim=0), image[3])
    hit = image[3] > 0.0
    assert hit.float().mean() > 0.5
    assert (image[:, ~hit] == 0.0).all()
    with pytest.raises(ValueError, match="does not spin"):
        SweepGrid.of_sensor(find_sensor("livox"), columns=100)


def test_noise_is_the_generators(yard, grid):
    images = BatchedCaster(BatchedWorld.from_world(yard), MAX_RANGE_M).images(
        torch.tensor(poses_on_route(yard, 2)), grid
    )
    model = find_sensor("vlp-16").ranging
    noisy, again, other = (with_range_noise(images, model, torch.Generator().manual_seed(seed)) for seed in (5, 5, 6))
    assert torch.equal(noisy, again)
    assert not torch.equal(noisy, other)
    kept = noisy[:, 3] > 0.0
    assert (images[:, 3][kept] > 0.0).all()
    scaled = (noisy[:, 3] - images[:, 3]) / (model.sigma_m + model.sigma_per_m * images[:, 3])
    assert scaled[kept].std() == pytest.approx(1.0, abs=0.05)
    assert 1.0 - kept.sum() / (images[:, 3] > 0.0).sum() == pytest.approx(model.dropout, abs=0.01)
    torch.testing.assert_close(noisy[:, :3].norm(dim=1), noisy[:, 3])


def test_images_can_be_trained_on(yard, grid):
    caster = BatchedCaster(BatchedWorld.from_world(yard), MAX_RANGE_M)
    images = caster.images(torch.tensor(poses_on_route(yard, 1)), grid)
    assert not images.requires_grad
    layer = torch.nn.Conv2d(4, 2, 3)
    layer(images).sum().backward()
    assert layer.weight.grad is not None
    with torch.inference_mode():
        assert torch.equal(caster.images(torch.tensor(poses_on_route(yard, 1)), grid), images)


def test_wrong_shapes_are_refused(yard, grid):
    caster = BatchedCaster(BatchedWorld.from_world(yard), MAX_RANGE_M)
    with pytest.raises(ValueError, match="T_world_lidar must be"):
        caster.images(torch.eye(3)[None], grid)
    with pytest.raises(ValueError, match="at least one world"):
        BatchedWorld.from_worlds([])


def test_open3d_is_not_needed():
    code = "import sys, lidarslam.simulation.batched_caster; print('open3d' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "False", done.stderr
