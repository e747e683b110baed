"""Office, tunnel, hall, stairs and crowd: the same from the same seed, closed all round, and free along the way."""

from dataclasses import replace
from functools import cache

import numpy as np
import open3d as o3d
import pytest

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.mesh import world_mesh
from lidarslam.simulation.world import Boxes, World, build_world
from lidarslam.simulation.worlds.building import UP
from lidarslam.simulation.worlds.paths import Clearance, subdivide_loop

NAMES = ("office", "tunnel", "hall", "stairs", "crowd")
SEEDS = (0, 1, 2)
ROUTE_LENGTHS_M = {
    "office": (40.0, 90.0),
    "tunnel": (150.0, 300.0),
    "hall": (150.0, 300.0),
    "stairs": (90.0, 200.0),
    "crowd": (45.0, 80.0),
}
FEWEST = {"stairs": (100, 40), "crowd": (200, 10)}  # boxes and cylinders, of worlds with little in them
STEEPEST = {"office": 0.0, "tunnel": 0.2, "hall": 0.12, "stairs": 0.17 / 0.28 + 1e-9, "crowd": 0.0}
# Below this above the floor lie rails, kerbs and roughness, which legs and wheels go over.
FLOOR_M = 0.15

Scene = o3d.t.geometry.RaycastingScene
cached_world = cache(build_world)
each_world = pytest.mark.parametrize(("name", "seed"), [(name, seed) for name in NAMES for seed in SEEDS])


def scene_around(world: World) -> Scene:
    mesh = world_mesh(world)
    scene = Scene()
    scene.add_triangles(mesh.vertices.astype(np.float32), np.asarray(mesh.triangles, dtype=np.uint32))
    return scene


@cache
def scene_of(name: str, seed: int) -> Scene:
    return scene_around(cached_world(name, seed))


def cast(scene: Scene, origins: FloatArray, directions: FloatArray) -> FloatArray:
    """Distance (N,) along unit vectors (N, 3), infinite where nothing is hit."""
    rays = np.concatenate(np.broadcast_arrays(origins, directions), axis=-1).reshape(-1, 6)
    return np.asarray(scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)))["t_hit"].numpy())


def arrays_of(world: World) -> list[FloatArray]:
    movers = [part for m in world.movers for part in (m.boxes.centres, m.waypoints, np.array([m.speed_mps, m.start_m]))]
    boxes, cylinders = world.boxes, world.cylinders
    solids = [boxes.centres, boxes.half_sizes, boxes.R_world_box, cylinders.starts, cylinders.ends, cylinders.radii]
    return [world.route.waypoints, *solids, *(f.heights for f in world.height_fields), *movers]


def level_frames(world: World, spacing_m: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points (N, 3) along the route, with level unit vectors (N, 3) ahead and to the left."""
    points = subdivide_loop(world.route.waypoints, spacing_m)
    ahead = (np.roll(points, -1, axis=0) - points) * [1.0, 1.0, 0.0]
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    return points, ahead, np.stack([-ahead[:, 1], ahead[:, 0], np.zeros(len(ahead))], axis=1)


@pytest.mark.parametrize("name", NAMES)
def test_the_same_seed_makes_the_same_bytes_and_another_one_another_world(name: str) -> None:
    first, second, other = cached_world(name, 0), build_world(name, 0), cached_world(name, 1)
    assert [a.tobytes() for a in arrays_of(first)] == [a.tobytes() for a in arrays_of(second)]
    assert first.boxes.centres.tobytes() != other.boxes.centres.tobytes()
    assert first.route.waypoints.tobytes() != other.route.waypoints.tobytes()


@each_world
def test_the_route_is_as_long_as_it_should_be_and_closed(name: str, seed: int) -> None:
    waypoints = cached_world(name, seed).route.waypoints
    legs = np.linalg.norm(np.roll(waypoints, -1, axis=0) - waypoints, axis=1)
    shortest, longest = ROUTE_LENGTHS_M[name]
    assert shortest <= legs.sum() <= longest
    assert legs.min() > 0.2


@each_world
def test_the_route_is_driven_on_something(name: str, seed: int) -> None:
    points, _, _ = level_frames(cached_world(name, seed), 0.5)
    below = cast(scene_of(name, seed), points + 0.5 * UP, np.array([0.0, 0.0, -1.0]))
    assert np.abs(below - 0.5).max() < 0.12


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


@each_world
def test_nothing_stands_on_the_route(name: str, seed: int) -> None:
    assert is_free(cached_world(name, seed), scene_of(name, seed))


@pytest.mark.parametrize("where", ["beside", "above"])
def test_a_post_or_a_beam_in_the_free_space_is_noticed(where: str) -> None:
    world = cached_world("hall", 0)
    points, _, left = level_frames(world, 0.5)
    side, height = world.route.free_side_m, world.route.free_height_m
    centre, half = {
        "beside": (points[40] + (side - 0.04) * left[40] + 0.5 * UP, np.array([0.03, 0.03, 0.5])),
        "above": (points[40] + (height + 0.05) * UP, np.array([0.1, 0.1, 0.1])),
    }[where]
    boxes = world.boxes
    planted = Boxes(
        np.vstack([boxes.centres, centre]),
        np.vstack([boxes.half_sizes, half]),
        np.concatenate([boxes.R_world_box, np.eye(3)[None]]),
    )
    assert not is_free(world, scene_around(replace(world, boxes=planted)))


@each_world
def test_rays_do_not_get_out(name: str, seed: int) -> None:
    points, _, _ = level_frames(cached_world(name, seed), 2.0)
    directions = np.random.default_rng(seed).normal(size=(150, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.repeat(points + 1.0 * UP, len(directions), axis=0)
    distances = cast(scene_of(name, seed), origins, np.tile(directions, (len(points), 1)))
    assert np.isfinite(distances).all()
    assert (distances < 60.0).mean() > 0.995


@each_world
def test_few_primitives_make_the_world(name: str, seed: int) -> None:
    world = cached_world(name, seed)
    boxes, cylinders = FEWEST.get(name, (400, 100))
    assert boxes < len(world.boxes) < 6000
    assert cylinders < len(world.cylinders) < 3000
    assert sum(field.heights.size for field in world.height_fields) < 1_000_000


@each_world
def test_slopes_are_gentle(name: str, seed: int) -> None:
    waypoints = cached_world(name, seed).route.waypoints
    steps = np.roll(waypoints, -1, axis=0) - waypoints
    slopes = np.abs(steps[:, 2]) / np.linalg.norm(steps[:, :2], axis=1)
    assert slopes.max() <= STEEPEST[name]


@pytest.mark.parametrize("seed", SEEDS)
def test_the_hall_is_climbed_over_two_decks_and_down_again(seed: int) -> None:
    z = cached_world("hall", seed).route.waypoints[:, 2]
    levels = np.unique(z.round(6))
    assert len(levels) == 3
    assert levels[1] > 2.4
    assert levels[2] == pytest.approx(2.0 * levels[1])


@pytest.mark.parametrize("seed", SEEDS)
def test_fork_lifts_stay_off_the_route(seed: int) -> None:
    world = cached_world("hall", seed)
    assert world.movers
    clearance = Clearance(world.route, margin_m=0.0)
    for mover in world.movers:
        for x, y, z in mover.waypoints:
            assert not clearance.on_route(np.array([x - 2.0, y - 2.0, z]), np.array([x + 2.0, y + 2.0, z + 2.2]))


@pytest.mark.parametrize("seed", SEEDS)
def test_the_tunnels_ground_is_what_is_driven_on(seed: int) -> None:
    world = cached_world("tunnel", seed)
    points = subdivide_loop(world.route.waypoints, 0.5)
    np.testing.assert_allclose(world.ground_at(points[:, :2]), points[:, 2], atol=0.1)
    ground, roof = world.height_fields
    border = np.ones(ground.heights.shape, dtype=bool)
    border[1:-1, 1:-1] = False
    assert (ground.heights[border] > roof.heights[border]).all()
