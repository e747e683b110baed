"""Streets, park, forest and fields: drawn from the seed alone, passable, closed, and standing on the ground."""

from collections.abc import Iterator

import numpy as np
import open3d as o3d
import pytest
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray, transform_points
from lidarslam.simulation.caster import Caster
from lidarslam.simulation.mesh import CYLINDER_SIDES, box_mesh, cylinder_mesh, merge
from lidarslam.simulation.route_motion import motion_along_route
from lidarslam.simulation.world import World, build_world
from lidarslam.simulation.worlds.paths import loop_length, subdivide_loop

NAMES = ("street", "park", "forest", "fields", "terrace")
SEEDS = (0, 3)  # for the street, one block and two
CASES = [(name, seed) for name in NAMES for seed in SEEDS]
LENGTHS_M = {
    "street": (290.0, 520.0),
    "park": (200.0, 400.0),
    "forest": (150.0, 300.0),
    "fields": (1600.0, 2100.0),
    "terrace": (850.0, 1100.0),
}
MOST_BOXES = {"street": 6000, "park": 8000, "forest": 8000, "fields": 5000, "terrace": 20_000}


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
    along = subdivide_loop(world.route.waypoints, 0.1)
    assert np.abs(along[:, 2] - world.ground_at(along[:, :2])).max() < 0.25


def test_the_route_lies_well_within_the_ground(world):
    field = world.height_fields[0]
    far = field.origin_xy + field.cell_m * (np.array(field.heights.shape) - 1)
    assert (world.route.waypoints[:, :2] > field.origin_xy + 20.0).all()
    assert (world.route.waypoints[:, :2] < far - 20.0).all()


def samples_of(world: World, near_m: float) -> FloatArray:
    """Points (N, 3) in the boxes and on the sides of the cylinders that may come that near to the route."""
    path = cKDTree(subdivide_loop(world.route.waypoints, 0.1)[:, :2])
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
    farther_m = 8.0 if world.name == "fields" else 0.0  # nothing else is near the route there
    points, path = samples_of(world, world.route.free_side_m + farther_m), subdivide_loop(world.route.waypoints, 0.1)
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
    eyes = subdivide_loop(world.route.waypoints, 0.1)[::5, None, None, :] + heights[:, None, None] * np.array(
        [0.0, 0.0, 1.0]
    )
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
    path = cKDTree(subdivide_loop(world.route.waypoints, 0.1)[:, :2])
    assert bool(world.movers) == (world.name not in ("forest", "fields"))
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


@pytest.mark.parametrize("seed", SEEDS)
def test_fields_can_be_crossed_at_any_speed_of_a_car(seed, worlds):
    world = worlds["fields", seed]
    for speed_mps in (10.0, 20.0, 30.0):
        motion = motion_along_route("car-fast", world, seed, speed_mps)
        positions = motion.pose_at(np.arange(0.0, 2.0 * motion.duration_s, 0.05))[:, :3, 3]
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        is_slower = np.flatnonzero(steps / 0.05 < 0.98 * speed_mps)
        travelled = np.cumsum(steps)
        longest = np.diff(travelled[is_slower]).max() if len(is_slower) else travelled[-1]
        assert longest > 300.0
        assert steps.min() / 0.05 > min(0.98 * speed_mps, 15.0)
        upwards = np.diff(positions[:, 2], 2) / 0.05**2
        assert np.abs(upwards).max() < 5.0


@pytest.mark.parametrize("seed", SEEDS)
def test_fields_roll_and_are_nearly_bare(seed, worlds):
    world = worlds["fields", seed]
    route = world.route.waypoints
    slope = np.diff(route[:, 2]) / np.linalg.norm(np.diff(route[:, :2], axis=0), axis=1)
    assert 0.015 < slope.std() < 0.06
    assert 3.0 < np.ptp(route[:, 2]) < 25.0
    eyes = route[::10] + np.array([0.0, 0.0, 1.73])
    angle = np.linspace(0.0, 2.0 * np.pi, 181)[:-1]
    rays = np.tile(np.stack([np.cos(angle), np.sin(angle), np.full(180, 0.06)], axis=1), (len(eyes), 1))
    solids = merge([box_mesh(world.boxes), cylinder_mesh(world.cylinders)])
    origins = np.repeat(eyes, 180, axis=0)
    ranges = Caster(world, solids).cast(origins, rays, np.zeros(len(rays)), 60.0).ranges
    assert 0.002 < np.isfinite(ranges).mean() < 0.1


@pytest.mark.parametrize("seed", SEEDS)
def test_grass_grows_beside_the_roads_and_not_on_them(seed, worlds):
    for name, kept_free_m, tallest_m in (("fields", 1.7, 1.0), ("terrace", 1.8, 0.25)):
        world = worlds[name, seed]
        assert world.grass is not None
        heights = world.grass.heights
        route = subdivide_loop(world.route.waypoints, 0.5)[:, :2]
        ring = kept_free_m * np.stack([np.cos(np.arange(8)), np.sin(np.arange(8))], axis=1)
        assert heights.height_at((route[:, None] + ring).reshape(-1, 2)).max() == 0.0
        assert 0.8 * tallest_m > heights.heights[heights.heights > 0.0].mean() > 0.04
        assert heights.heights.max() < tallest_m
        assert (heights.heights.shape, heights.cell_m) == (
            world.height_fields[0].heights.shape,
            world.height_fields[0].cell_m,
        )


@pytest.mark.parametrize("seed", SEEDS)
def test_a_terrace_looks_alike_from_every_house(seed, worlds):
    """Ranges to the facades are those one house on, but for what stands before a few of them."""
    world = worlds["terrace", seed]
    caster = Caster(world, box_mesh(world.boxes))
    step_m = 0.02
    x = np.arange(120.0, 260.0, step_m)
    ground = world.ground_at(np.column_stack([x, np.zeros(len(x))]))
    widths = np.arange(round(5.0 / step_m), round(7.0 / step_m))
    for outward in (-1.0, 1.0):  # of the first street, along y = 0
        rays = np.tile([0.0, outward, 0.0], (len(x), 1))
        eyes = [np.column_stack([x, np.zeros(len(x)), ground + height]) for height in (1.2, 2.5, 4.5)]
        profile = np.stack([caster.cast(at, rays, np.zeros(len(x)), 50.0).ranges for at in eyes])
        alike = np.array([(np.abs(profile[:, k:] - profile[:, :-k]) < 0.05).mean() for k in widths])
        assert alike.max() > 0.9
        assert np.median(alike) < 0.8  # there is relief to be alike
