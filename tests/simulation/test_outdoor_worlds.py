"""Street, park and forest: drawn from the seed alone, passable, closed, and standing on the ground."""

from collections.abc import Iterator

import numpy as np
import open3d as o3d
import pytest
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray, transform_points
from lidarslam.simulation.mesh import CYLINDER_SIDES, box_mesh, cylinder_mesh, merge
from lidarslam.simulation.world import World
from lidarslam.simulation.worlds.clearance import sample_route
from lidarslam.simulation.worlds.paths import loop_length
from lidarslam.simulation.worlds.registry import build_world

NAMES = ("street", "park", "forest")
SEEDS = (0, 3)  # for the street, one block and two
CASES = [(name, seed) for name in NAMES for seed in SEEDS]
LENGTHS_M = {"street": (290.0, 520.0), "park": (200.0, 400.0), "forest": (150.0, 300.0)}
MOST_BOXES = {"street": 6000, "park": 8000, "forest": 8000}


@pytest.fixture(scope="module")
def worlds() -> dict[tuple[str, int], World]:
    return {case: build_world(*case) for case in CASES}


@pytest.fixture(params=CASES, ids=lambda case: f"{case[0]}-{case[1]}")
def world(request, worlds) -> World:
    return worlds[request.param]


def arrays_of(world: World) -> Iterator[FloatArray]:
    yield world.route.waypoints
    for boxes in (world.boxes, *(mover.boxes for mover in world.movers)):
        yield from (boxes.centres, boxes.half_sizes, boxes.R_world_box)
    yield from (world.cylinders.starts, world.cylinders.ends, world.cylinders.radii)
    yield from (field.heights for field in world.height_fields)
    yield from (np.append(mover.waypoints, [mover.speed_mps, mover.start_m]) for mover in world.movers)


def bytes_of(world: World) -> bytes:
    return b"".join(array.tobytes() for array in arrays_of(world))


@pytest.mark.parametrize("name", NAMES)
def test_the_seed_makes_the_world(name, worlds):
    again = build_world(name, 0)
    assert bytes_of(again) == bytes_of(worlds[name, 0])
    assert bytes_of(again) != bytes_of(worlds[name, 3])
    assert (again.name, again.seed) == (name, 0)


def test_it_is_finite_and_not_too_much(world):
    assert all(np.isfinite(array).all() for array in arrays_of(world))
    assert 500 < len(world.boxes) < MOST_BOXES[world.name]
    assert 100 < len(world.cylinders) < 4000


def test_the_route_is_a_loop_on_the_ground(world):
    points = world.route.waypoints
    low, high = LENGTHS_M[world.name]
    assert low <= loop_length(world.route.waypoints) <= high
    np.testing.assert_allclose(points[:, 2], world.ground_at(points[:, :2]), atol=1e-9)
    steps = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    assert steps.min() > 0.1
    assert steps.max() < 6.0  # the last is joined to the first like any other
    along = sample_route(world.route)
    assert np.abs(along[:, 2] - world.ground_at(along[:, :2])).max() < 0.25


def test_the_route_lies_well_within_the_ground(world):
    field = world.height_fields[0]
    far = field.origin_xy + field.cell_m * (np.array(field.heights.shape) - 1)
    assert (world.route.waypoints[:, :2] > field.origin_xy + 20.0).all()
    assert (world.route.waypoints[:, :2] < far - 20.0).all()


def samples_of(world: World, near_m: float) -> FloatArray:
    """Points (N, 3) in the boxes and on the sides of the cylinders that may come that near to the route."""
    path = cKDTree(sample_route(world.route)[:, :2])
    boxes, cylinders = world.boxes, world.cylinders
    near = path.query(boxes.centres[:, :2])[0] < near_m + np.linalg.norm(boxes.half_sizes, axis=1)
    grid = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 7)] * 3), axis=-1).reshape(-1, 3)
    inside = (grid * boxes.half_sizes[near, None]) @ np.swapaxes(boxes.R_world_box[near], 1, 2)
    rims = cylinder_mesh(cylinders).vertices.reshape(len(cylinders), 2 + 2 * CYLINDER_SIDES, 3)[:, 2:]
    middle, reach = rims.mean(axis=1), np.linalg.norm(rims - rims.mean(axis=1, keepdims=True), axis=2).max(axis=1)
    rims = rims[path.query(middle[:, :2])[0] < near_m + reach]
    starts, ends = rims[:, None, :CYLINDER_SIDES], rims[:, None, CYLINDER_SIDES:]
    sides = starts + np.linspace(0.0, 1.0, 21)[:, None, None] * (ends - starts)
    return np.concatenate([(boxes.centres[near, None] + inside).reshape(-1, 3), sides.reshape(-1, 3)])


def test_nothing_solid_reaches_into_the_free_space(world):
    points, path = samples_of(world, world.route.free_side_m), sample_route(world.route)
    distance, nearest = cKDTree(path[:, :2]).query(points[:, :2], distance_upper_bound=world.route.free_side_m)
    beneath = np.isfinite(distance)  # within the free side: it must be above the free height, or in the ground
    above = points[beneath, 2] - path[nearest[beneath], 2]
    assert (above >= world.route.free_height_m).all()
    assert len(points) > 1000  # else this looked at nothing


def test_nobody_on_the_route_sees_anything_within_the_free_side(world):
    solids = merge([box_mesh(world.boxes), cylinder_mesh(world.cylinders)])
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(solids.vertices.astype(np.float32)), o3d.core.Tensor(solids.triangles.astype(np.uint32))
    )
    angle = np.linspace(0.0, 2.0 * np.pi, 49)[:-1]
    directions = np.stack([np.cos(angle), np.sin(angle), np.zeros(48)], axis=1)
    heights = np.linspace(0.3, world.route.free_height_m - 0.05, 8)
    eyes = sample_route(world.route)[::5, None, None, :] + heights[:, None, None] * np.array([0.0, 0.0, 1.0])
    rays = np.concatenate(np.broadcast_arrays(eyes, directions), axis=-1).astype(np.float32)
    seen = scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
    assert seen.min() >= world.route.free_side_m
    assert seen.min() < 15.0


def test_what_stands_is_rooted_in_the_ground(world):
    starts, ends, radii = world.cylinders.starts, world.cylinders.ends, world.cylinders.radii
    low = np.where((starts[:, 2] < ends[:, 2])[:, None], starts, ends)
    is_upright = np.abs(ends - starts)[:, 2] > 0.9 * np.linalg.norm(ends - starts, axis=1)
    above = low[:, 2] - world.ground_at(low[:, :2])
    trunks = is_upright & (radii > 0.09) & (above < 0.5)
    assert trunks.sum() > 10
    assert above[trunks].max() < -0.1


def test_houses_reach_below_the_ground_and_wheels_just_to_it(worlds):
    for seed in SEEDS:
        world = worlds["street", seed]
        corners = box_mesh(world.boxes).vertices.reshape(-1, 8, 3)
        above = corners[..., 2] - world.ground_at(corners[..., :2].reshape(-1, 2)).reshape(-1, 8)
        # What is taller than a storey and comes down to a man's height is a wall or what is behind it.
        walls = (world.boxes.half_sizes[:, 2] > 1.5) & (above.min(axis=1) < 1.8) & (above.max(axis=1) > 4.0)
        assert walls.sum() > 200
        assert above[walls, :4].max() < -0.5
        cylinders = world.cylinders
        wheels = cylinders.radii == 0.33
        middle = 0.5 * (cylinders.starts + cylinders.ends)[wheels]
        assert len(middle) > 40
        assert np.abs(middle[:, 2] - 0.33 - world.ground_at(middle[:, :2])).max() < 0.09


def test_movers_stay_on_the_ground_and_off_the_route(world):
    path = cKDTree(sample_route(world.route)[:, :2])
    assert bool(world.movers) == (world.name != "forest")
    for mover in world.movers:
        length = np.linalg.norm(np.roll(mover.waypoints, -1, axis=0) - mover.waypoints, axis=1).sum()
        poses = mover.pose_at(np.linspace(0.0, length / mover.speed_mps, 150))
        assert np.abs(poses[:, 2, 3] - world.ground_at(poses[:, :2, 3])).max() < 0.1
        corners = transform_points(poses, box_mesh(mover.boxes).vertices).reshape(-1, 3)
        assert np.isinf(path.query(corners[:, :2], distance_upper_bound=world.route.free_side_m)[0]).all()


def test_from_all_over_the_park_some_upright_things_are_near(worlds):
    for seed in SEEDS:
        world = worlds["park", seed]
        cylinders = world.cylinders
        is_upright = (cylinders.ends - cylinders.starts)[:, 2] > 1.5
        feet = cylinders.starts[is_upright & (cylinders.radii > 0.05), :2]
        for point in world.route.waypoints:
            offsets = feet - point[:2]
            offsets = offsets[np.linalg.norm(offsets, axis=1) < 40.0]
            bearings = np.sort(np.arctan2(offsets[:, 1], offsets[:, 0]))
            assert len(np.unique(bearings.round(2))) >= 5
            assert np.diff(np.append(bearings, bearings[0] + 2.0 * np.pi)).max() < np.deg2rad(200.0)


def test_street_slopes_are_gentle_and_its_road_lies_a_kerb_lower_than_its_pavement(worlds):
    world = worlds["street", 0]
    route = world.route.waypoints
    slope = np.diff(route[:, 2]) / np.linalg.norm(np.diff(route[:, :2], axis=0), axis=1)
    assert 0.005 < np.abs(slope).max() < 0.12
    ahead = np.roll(route, -1, axis=0) - route
    right = np.stack([ahead[:, 1], -ahead[:, 0]], axis=1) / np.linalg.norm(ahead[:, :2], axis=1, keepdims=True)
    straight = np.linalg.norm(ahead, axis=1) > 3.0
    # The kerb is 6 m from the middle line, the lane's middle 1.75 m; what the ground itself slopes averages out.
    rise = world.ground_at((route[:, :2] + 4.85 * right)[straight]) - world.ground_at(
        (route[:, :2] + 4.2 * right)[straight]
    )
    assert np.median(rise) == pytest.approx(0.12, abs=0.03)


def test_forests_differ_in_their_trunks_and_keep_them_apart(worlds):
    for seed in SEEDS:
        cylinders = worlds["forest", seed].cylinders
        axis = cylinders.ends - cylinders.starts
        trunks = (axis[:, 2] > 3.0) & (
            cylinders.starts[:, 2] < worlds["forest", seed].ground_at(cylinders.starts[:, :2])
        )
        assert 250 < trunks.sum() < 600
        radii = cylinders.radii[trunks]
        assert radii.min() >= 0.1
        assert radii.max() <= 0.5
        assert radii.std() > 0.04
        apart = cKDTree(cylinders.starts[trunks, :2]).query(cylinders.starts[trunks, :2], k=2)[0][:, 1]
        assert apart.min() > 1.7
