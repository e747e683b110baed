"""Every world: the same from the same seed, free along the way, standing on its ground; indoors closed all round."""

from collections.abc import Iterator
from functools import cache

import numpy as np
import open3d as o3d
import pytest
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray, transform_points
from lidarslam.simulation.mesh import CYLINDER_SIDES, Mesh, box_mesh, cylinder_mesh, merge, world_mesh
from lidarslam.simulation.route_motion import motion_along_route
from lidarslam.simulation.world import WORLDS, World, build_world
from lidarslam.simulation.worlds.building import UP
from lidarslam.simulation.worlds.paths import Clearance, loop_length, subdivide_loop

# Name: shortest and longest route, fewest and most boxes, fewest and most cylinders.
INDOORS = {
    "office": ((40.0, 90.0), (400, 6000), (100, 3000)),
    "tunnel": ((150.0, 300.0), (400, 6000), (100, 3000)),
    "hall": ((150.0, 300.0), (400, 6000), (100, 3000)),
    "stairs": ((90.0, 200.0), (100, 6000), (40, 3000)),
    "crowd": ((45.0, 80.0), (200, 6000), (10, 3000)),
}
OUTDOORS = {
    "street": ((290.0, 520.0), (500, 6000), (100, 4000)),
    "park": ((200.0, 400.0), (500, 8000), (100, 4000)),
    "forest": ((150.0, 300.0), (500, 8000), (100, 4000)),
    "fields": ((1600.0, 2100.0), (500, 5000), (100, 4000)),
    "terrace": ((850.0, 1100.0), (500, 20_000), (100, 4000)),
}
INDOOR_SEEDS = (0, 1, 2)
SEEDS = (0, 3)  # for the street, one block and two
INSIDE = [(name, seed) for name in INDOORS for seed in INDOOR_SEEDS]
OUTSIDE = [(name, seed) for name in OUTDOORS for seed in SEEDS]
STEEPEST = {"office": 0.0, "tunnel": 0.2, "hall": 0.12, "stairs": 0.17 / 0.28 + 1e-9, "crowd": 0.0}
# Below this above the floor lie rails, kerbs and roughness, which legs and wheels go over.
FLOOR_M = 0.15

Scene = o3d.t.geometry.RaycastingScene
cached_world = cache(build_world)
each_inside = pytest.mark.parametrize(("name", "seed"), INSIDE)
each_seed = pytest.mark.parametrize("seed", SEEDS)


@pytest.fixture(params=OUTSIDE, ids=lambda case: f"{case[0]}-{case[1]}")
def world(request) -> World:
    return cached_world(*request.param)


def scene_of_mesh(mesh: Mesh) -> Scene:
    scene = Scene()
    scene.add_triangles(mesh.vertices.astype(np.float32), np.asarray(mesh.triangles, dtype=np.uint32))
    return scene


@cache
def scene_of(name: str, seed: int) -> Scene:
    return scene_of_mesh(world_mesh(cached_world(name, seed)))


def cast(scene: Scene, origins: FloatArray, directions: FloatArray) -> FloatArray:
    """Distance (N,) along unit vectors (N, 3), infinite where nothing is hit."""
    rays = np.concatenate(np.broadcast_arrays(origins, directions), axis=-1).reshape(-1, 6)
    return np.asarray(scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)))["t_hit"].numpy())


def arrays_of(world: World) -> Iterator[FloatArray]:
    yield world.route.waypoints
    for boxes in (world.boxes, *(mover.boxes for mover in world.movers)):
        yield from (boxes.centres, boxes.half_sizes, boxes.R_world_box)
    yield from (world.cylinders.starts, world.cylinders.ends, world.cylinders.radii)
    yield from (field.heights for field in world.height_fields)
    yield from (np.append(mover.waypoints, [mover.speed_mps, mover.start_m]) for mover in world.movers)


def level_frames(world: World, spacing_m: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points (N, 3) along the route, with level unit vectors (N, 3) ahead and to the left."""
    points = subdivide_loop(world.route.waypoints, spacing_m)
    ahead = (np.roll(points, -1, axis=0) - points) * [1.0, 1.0, 0.0]
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    return points, ahead, np.stack([-ahead[:, 1], ahead[:, 0], np.zeros(len(ahead))], axis=1)


def bytes_of(world: World) -> bytes:
    return b"".join(array.tobytes() for array in arrays_of(world))


@pytest.mark.parametrize("name", [name for name in WORLDS if name != "town"])
def test_the_seed_makes_the_world(name: str) -> None:
    first, again, other = cached_world(name, 0), build_world(name, 0), cached_world(name, 3)
    assert bytes_of(again) == bytes_of(first)
    assert first.boxes.centres.tobytes() != other.boxes.centres.tobytes()
    assert first.route.waypoints.tobytes() != other.route.waypoints.tobytes()
    assert (again.name, again.seed) == (name, 0)


@pytest.mark.parametrize(("name", "seed"), [*INSIDE, *OUTSIDE])
def test_it_is_finite_and_of_the_stated_size(name: str, seed: int) -> None:
    world = cached_world(name, seed)
    assert all(np.isfinite(array).all() for array in arrays_of(world))
    (shortest, longest), boxes, cylinders = (INDOORS | OUTDOORS)[name]
    assert shortest <= loop_length(world.route.waypoints) <= longest
    assert boxes[0] < len(world.boxes) < boxes[1]
    assert cylinders[0] < len(world.cylinders) < cylinders[1]
    if name in INDOORS:
        assert sum(field.heights.size for field in world.height_fields) < 1_000_000


@each_inside
def test_indoor_routes_are_driven_on_something_and_gentle(name: str, seed: int) -> None:
    points, _, _ = level_frames(cached_world(name, seed), 0.5)
    below = cast(scene_of(name, seed), points + 0.5 * UP, np.array([0.0, 0.0, -1.0]))
    assert np.abs(below - 0.5).max() < 0.12
    waypoints = cached_world(name, seed).route.waypoints
    steps = np.roll(waypoints, -1, axis=0) - waypoints
    assert np.linalg.norm(steps, axis=1).min() > 0.2
    assert (np.abs(steps[:, 2]) / np.linalg.norm(steps[:, :2], axis=1)).max() <= STEEPEST[name]


def is_free(world: World, scene: Scene) -> bool:
    """Whether rays to both sides, along and upwards meet nothing in the free space of the route."""
    points, ahead, left = level_frames(world, 0.05)
    side, height = world.route.free_side_m, world.route.free_height_m
    for z in np.linspace(FLOOR_M, height, 8):
        # At a corner "ahead" is only known up to the corner.
        for direction, reach in ((left, side), (-left, side), (ahead, 0.05), (-ahead, 0.05)):
            if cast(scene, points + z * UP, direction).min() < reach - 1e-3:
                return False
    for offset in np.linspace(-side, side, 7):
        if cast(scene, points + offset * left + FLOOR_M * UP, UP).min() < height - FLOOR_M - 1e-3:
            return False
    return True


@each_inside
def test_nothing_stands_on_an_indoor_route(name: str, seed: int) -> None:
    assert is_free(cached_world(name, seed), scene_of(name, seed))


@each_inside
def test_rays_do_not_get_out(name: str, seed: int) -> None:
    points, _, _ = level_frames(cached_world(name, seed), 2.0)
    directions = np.random.default_rng(seed).normal(size=(150, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.repeat(points + 1.0 * UP, len(directions), axis=0)
    distances = cast(scene_of(name, seed), origins, np.tile(directions, (len(points), 1)))
    assert np.isfinite(distances).all()
    assert (distances < 60.0).mean() > 0.995


@pytest.mark.parametrize("seed", INDOOR_SEEDS)
def test_the_hall_is_climbed_over_two_decks_and_down_again(seed: int) -> None:
    z = cached_world("hall", seed).route.waypoints[:, 2]
    levels = np.unique(z.round(6))
    assert len(levels) == 3
    assert levels[1] > 2.4
    assert levels[2] == pytest.approx(2.0 * levels[1])


@pytest.mark.parametrize("seed", INDOOR_SEEDS)
def test_fork_lifts_stay_off_the_route(seed: int) -> None:
    world = cached_world("hall", seed)
    assert world.movers
    clearance = Clearance(world.route, margin_m=0.0)
    for mover in world.movers:
        for x, y, z in mover.waypoints:
            assert not clearance.on_route(np.array([x - 2.0, y - 2.0, z]), np.array([x + 2.0, y + 2.0, z + 2.2]))


@pytest.mark.parametrize("seed", INDOOR_SEEDS)
def test_the_tunnels_ground_is_what_is_driven_on(seed: int) -> None:
    world = cached_world("tunnel", seed)
    points = subdivide_loop(world.route.waypoints, 0.5)
    np.testing.assert_allclose(world.ground_at(points[:, :2]), points[:, 2], atol=0.1)
    ground, roof = world.height_fields
    border = np.ones(ground.heights.shape, dtype=bool)
    border[1:-1, 1:-1] = False
    assert (ground.heights[border] > roof.heights[border]).all()


def test_an_outdoor_route_is_a_loop_on_the_ground_and_well_within_it(world: World) -> None:
    points, field = world.route.waypoints, world.height_fields[0]
    np.testing.assert_allclose(points[:, 2], world.ground_at(points[:, :2]), atol=1e-9)
    steps = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    assert steps.min() > 0.1
    assert steps.max() < 6.0  # the last is joined to the first like any other
    along = subdivide_loop(points, 0.1)
    assert np.abs(along[:, 2] - world.ground_at(along[:, :2])).max() < 0.25
    far = field.origin_xy + field.cell_m * (np.array(field.heights.shape) - 1)
    assert (points[:, :2] > field.origin_xy + 20.0).all()
    assert (points[:, :2] < far - 20.0).all()


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


def test_nobody_on_the_route_sees_anything_within_the_free_side(world: World) -> None:
    scene = scene_of_mesh(merge([box_mesh(world.boxes), cylinder_mesh(world.cylinders)]))
    angle = np.linspace(0.0, 2.0 * np.pi, 49)[:-1]
    directions = np.stack([np.cos(angle), np.sin(angle), np.zeros(48)], axis=1)
    heights = np.linspace(0.3, world.route.free_height_m - 0.05, 8)
    eyes = subdivide_loop(world.route.waypoints, 0.1)[::5, None, None, :] + heights[:, None, None] * UP
    seen = cast(scene, eyes, directions)
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


def test_movers_stay_on_the_ground_and_off_the_route(world):
    path = cKDTree(subdivide_loop(world.route.waypoints, 0.1)[:, :2])
    assert bool(world.movers) == (world.name not in ("forest", "fields"))
    for mover in world.movers:
        length = np.linalg.norm(np.roll(mover.waypoints, -1, axis=0) - mover.waypoints, axis=1).sum()
        poses = mover.pose_at(np.linspace(0.0, length / mover.speed_mps, 150))
        assert np.abs(poses[:, 2, 3] - world.ground_at(poses[:, :2, 3])).max() < 0.1
        corners = transform_points(poses, box_mesh(mover.boxes).vertices).reshape(-1, 3)
        assert np.isinf(path.query(corners[:, :2], distance_upper_bound=world.route.free_side_m)[0]).all()


@each_seed
def test_fields_can_be_crossed_at_any_speed_of_a_car(seed):
    world = cached_world("fields", seed)
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


@each_seed
def test_grass_grows_beside_the_roads_and_not_on_them(seed):
    for name, kept_free_m, tallest_m in (("fields", 1.7, 1.0), ("terrace", 1.8, 0.25)):
        world = cached_world(name, seed)
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
