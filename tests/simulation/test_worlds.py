"""Every world: the same from the same seed, free along the way, standing on its ground; indoors closed all round."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray, transform_points
from lidarslam.simulation.mesh import Caster, box_mesh, cylinder_mesh, merge
from lidarslam.simulation.route_motion import motion_along_route
from lidarslam.simulation.world import WORLDS, World, build_world
from lidarslam.simulation.worlds import town
from lidarslam.simulation.worlds.building import UP
from lidarslam.simulation.worlds.hard_places import COMPANIONS, CROSSING, STANDING
from lidarslam.simulation.worlds.paths import Clearance, loop_length, subdivide_loop

from .conftest import cached_world, cast, caster_of

# Name: shortest and longest route, most boxes, most cylinders.
INDOORS = {
    "office": ((40.0, 90.0), 6000, 3000),
    "tunnel": ((150.0, 300.0), 6000, 3000),
    "hall": ((150.0, 300.0), 6000, 3000),
    "stairs": ((90.0, 200.0), 6000, 3000),
    "crowd": ((45.0, 80.0), 6000, 3000),
}
OUTDOORS = {
    "street": ((290.0, 520.0), 6000, 4000),
    "park": ((200.0, 400.0), 8000, 4000),
    "forest": ((150.0, 300.0), 8000, 4000),
    "fields": ((1600.0, 2100.0), 5000, 4000),
    "terrace": ((850.0, 1100.0), 20_000, 4000),
}
SEEDS = (0, 3)  # for the street, one block and two
STEEPEST = {"office": 0.0, "tunnel": 0.2, "hall": 0.12, "stairs": 0.17 / 0.28 + 1e-9, "crowd": 0.0}
# Below this above the floor lie rails, kerbs and roughness, which legs and wheels go over.
FLOOR_M = 0.15


def cases(*names: str) -> pytest.MarkDecorator:
    """Each world and seed; a second one of the large worlds, which take seconds to build, with the slow tests."""
    slow = [(name, 3) for name in OUTDOORS if name != "street"]
    pairs = [(name, seed) for name in names for seed in SEEDS]
    marked = [pytest.param(*pair, marks=pytest.mark.slow if pair in slow else ()) for pair in pairs]
    return pytest.mark.parametrize(("name", "seed"), marked)


each_inside, each_outside, each_world = cases(*INDOORS), cases(*OUTDOORS), cases(*INDOORS, *OUTDOORS)
each_seed = pytest.mark.parametrize("seed", SEEDS)


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


SMALL = ("hall", "stairs", "crowd", "corridor")


@pytest.mark.parametrize(
    "name", [*SMALL, *(pytest.param(n, marks=pytest.mark.slow) for n in WORLDS if n not in (*SMALL, "town"))]
)
def test_the_seed_makes_the_world(name: str) -> None:
    first, again, other = cached_world(name, 0), build_world(name, 0), cached_world(name, 3)
    assert all(map(np.array_equal, arrays_of(first), arrays_of(again)))
    assert first.boxes.centres.tobytes() != other.boxes.centres.tobytes()
    assert first.route.waypoints.tobytes() != other.route.waypoints.tobytes()
    assert (again.name, again.seed) == (name, 0)


@each_world
def test_it_is_finite_and_of_the_stated_size(name: str, seed: int) -> None:
    world = cached_world(name, seed)
    assert all(np.isfinite(array).all() for array in arrays_of(world))
    (shortest, longest), most_boxes, most_cylinders = (INDOORS | OUTDOORS)[name]
    assert shortest <= loop_length(world.route.waypoints) <= longest
    assert 100 < len(world.boxes) < most_boxes
    assert 10 < len(world.cylinders) < most_cylinders
    if name in INDOORS:
        assert sum(field.heights.size for field in world.height_fields) < 1_000_000


@each_inside
def test_indoor_routes_are_driven_on_something_and_gentle(name: str, seed: int) -> None:
    points, _, _ = level_frames(cached_world(name, seed), 0.5)
    below = cast(caster_of(name, seed), points + 0.5 * UP, np.array([0.0, 0.0, -1.0]))
    assert np.abs(below - 0.5).max() < 0.12
    waypoints = cached_world(name, seed).route.waypoints
    steps = np.roll(waypoints, -1, axis=0) - waypoints
    assert np.linalg.norm(steps, axis=1).min() > 0.2
    assert (np.abs(steps[:, 2]) / np.linalg.norm(steps[:, :2], axis=1)).max() <= STEEPEST[name]


@each_world
def test_nothing_stands_on_the_route(name: str, seed: int) -> None:
    """Rays to both sides, along and upwards meet nothing in the free space of the route, save the ground outdoors."""
    world = cached_world(name, seed)
    solids = merge([box_mesh(world.boxes), cylinder_mesh(world.cylinders)])
    caster = caster_of(name, seed) if name in INDOORS else Caster(world, solids)
    points, ahead, left = level_frames(world, 0.05 if name in INDOORS else 0.1)
    side, height = world.route.free_side_m, world.route.free_height_m
    for z in np.linspace(FLOOR_M, height, 8):
        # At a corner "ahead" is only known up to the corner.
        for direction, reach in ((left, side), (-left, side), (ahead, 0.05), (-ahead, 0.05)):
            assert cast(caster, points + z * UP, direction).min() > reach - 1e-3
    for offset in np.linspace(-side, side, 7):
        assert cast(caster, points + offset * left + FLOOR_M * UP, UP).min() > height - FLOOR_M - 1e-3


@each_inside
def test_rays_do_not_get_out(name: str, seed: int) -> None:
    points, _, _ = level_frames(cached_world(name, seed), 4.0)
    directions = np.random.default_rng(seed).normal(size=(150, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.repeat(points + 1.0 * UP, len(directions), axis=0)
    distances = cast(caster_of(name, seed), origins, np.tile(directions, (len(points), 1)))
    assert np.isfinite(distances).all()
    assert (distances < 60.0).mean() > 0.995


@each_seed
def test_the_hall_is_climbed_over_two_decks_past_its_fork_lifts(seed: int) -> None:
    world = cached_world("hall", seed)
    levels = np.unique(world.route.waypoints[:, 2].round(6))
    assert len(levels) == 3
    assert levels[1] > 2.4
    assert levels[2] == pytest.approx(2.0 * levels[1])
    assert world.movers
    clearance = Clearance(world.route, margin_m=0.0)
    for mover in world.movers:
        for x, y, z in mover.waypoints:
            assert not clearance.on_route(np.array([x - 2.0, y - 2.0, z]), np.array([x + 2.0, y + 2.0, z + 2.2]))


@each_seed
def test_the_tunnels_ground_is_what_is_driven_on(seed: int) -> None:
    world = cached_world("tunnel", seed)
    points = subdivide_loop(world.route.waypoints, 0.5)
    np.testing.assert_allclose(world.ground_at(points[:, :2]), points[:, 2], atol=0.1)
    ground, roof = world.height_fields
    border = np.ones(ground.heights.shape, dtype=bool)
    border[1:-1, 1:-1] = False
    assert (ground.heights[border] > roof.heights[border]).all()


@each_outside
def test_an_outdoor_route_is_a_loop_on_the_ground_and_well_within_it(name: str, seed: int) -> None:
    world = cached_world(name, seed)
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


@each_outside
def test_what_stands_is_rooted_in_the_ground(name: str, seed: int) -> None:
    world = cached_world(name, seed)
    starts, ends, radii = world.cylinders.starts, world.cylinders.ends, world.cylinders.radii
    low = np.where((starts[:, 2] < ends[:, 2])[:, None], starts, ends)
    is_upright = np.abs(ends - starts)[:, 2] > 0.9 * np.linalg.norm(ends - starts, axis=1)
    above = low[:, 2] - world.ground_at(low[:, :2])
    trunks = is_upright & (radii > 0.09) & (above < 0.5)
    assert trunks.sum() > 10
    assert above[trunks].max() < -0.1


@each_outside
def test_movers_stay_on_the_ground_and_off_the_route(name: str, seed: int) -> None:
    world = cached_world(name, seed)
    path = cKDTree(subdivide_loop(world.route.waypoints, 0.1)[:, :2])
    assert bool(world.movers) == (world.name not in ("forest", "fields"))
    for mover in world.movers:
        poses = mover.pose_at(np.linspace(0.0, loop_length(mover.waypoints) / mover.speed_mps, 150))
        assert np.abs(poses[:, 2, 3] - world.ground_at(poses[:, :2, 3])).max() < 0.1
        corners = transform_points(poses, box_mesh(mover.boxes).vertices).reshape(-1, 3)
        assert np.isinf(path.query(corners[:, :2], distance_upper_bound=world.route.free_side_m)[0]).all()


@pytest.mark.parametrize("speed_mps", [10.0, 30.0])
def test_fields_can_be_crossed_at_any_speed_of_a_car(speed_mps: float) -> None:
    motion = motion_along_route("car-fast", cached_world("fields", 0), 0, speed_mps)
    positions = motion.pose_at(np.arange(0.0, 2.0 * motion.duration_s, 0.05))[:, :3, 3]
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    is_slower = np.flatnonzero(steps / 0.05 < 0.98 * speed_mps)
    travelled = np.cumsum(steps)
    assert (np.diff(travelled[is_slower]).max() if len(is_slower) else travelled[-1]) > 300.0
    assert steps.min() / 0.05 > min(0.98 * speed_mps, 15.0)
    assert np.abs(np.diff(positions[:, 2], 2) / 0.05**2).max() < 5.0


@pytest.mark.parametrize(("name", "kept_free_m", "tallest_m"), [("fields", 1.7, 1.0), ("terrace", 1.8, 0.25)])
def test_grass_grows_beside_the_roads_and_not_on_them(name: str, kept_free_m: float, tallest_m: float) -> None:
    world = cached_world(name, 0)
    assert world.grass is not None
    grass, ground = world.grass.heights, world.height_fields[0]
    route = subdivide_loop(world.route.waypoints, 0.5)[:, :2]
    ring = kept_free_m * np.stack([np.cos(np.arange(8)), np.sin(np.arange(8))], axis=1)
    assert grass.height_at((route[:, None] + ring).reshape(-1, 2)).max() == 0.0
    assert 0.8 * tallest_m > grass.heights[grass.heights > 0.0].mean() > 0.04
    assert grass.heights.max() < tallest_m
    assert (grass.heights.shape, grass.cell_m) == (ground.heights.shape, ground.cell_m)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_corridor_opens_into_a_yard_and_recordings_begin_deep_in_it(seed: int) -> None:
    world = cached_world("corridor", seed)
    waypoints = world.route.waypoints
    length = 1.2 - float(waypoints[:, 0].min())
    mouth = np.array([[-0.5, 0.0, 1.2]])
    ahead = cast(caster_of("corridor", seed), mouth, np.array([1.0, 0.0, 0.0]))
    assert 5.0 < ahead[0] < 41.0  # a tree may stand before the far side
    assert np.ptp(waypoints[:, 1]) > 13.0
    motion = motion_along_route("handheld", world, seed)
    start, later = motion.pose_at(np.array([0.0, 8.0]))[:, :3, 3]
    assert -0.7 * length < start[0] < -0.5 * length
    assert later[0] > start[0] + 3.0  # on its way out
    np.testing.assert_array_equal(waypoints[:, 2], world.ground_at(waypoints[:, :2]))


@pytest.mark.parametrize("seed", [0, 1])
def test_a_carrier_climbs_the_stairs_smoothly_and_comes_down_again(seed: int) -> None:
    world = cached_world("stairs", seed)
    motion = replace(motion_along_route("handheld", world, seed), sway=())
    times = np.arange(0.0, motion.duration_s, 0.01)
    z = motion.pose_at(times)[:, 2, 3]
    assert z.max() == pytest.approx(world.route.waypoints[:, 2].max(), abs=0.05)
    assert z.max() > 4 * 2 * 9 * 0.17 - 0.05
    assert abs(z[0]) < 1e-9
    assert abs(z[-1]) < 1e-9
    climb = np.gradient(z, times)
    assert 0.4 < np.abs(climb).max() < 0.55
    assert np.abs(np.gradient(climb, times)).max() < 1.0
    level = np.linalg.norm(np.diff(motion.pose_at(times)[:, :2, 3], axis=0), axis=1)
    steep = np.abs(climb[1:]) > 0.35
    assert np.median(np.abs(np.diff(z))[steep] / level[steep]) == pytest.approx(0.17 / 0.28, rel=0.01)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_crowd_is_around_the_start_and_half_of_it_goes_along(seed: int) -> None:
    world = cached_world("crowd", seed)
    motion = motion_along_route("handheld", world, seed)
    assert len(world.movers) == COMPANIONS + STANDING + CROSSING == 30
    times = np.arange(0.0, 8.0, 0.5)
    carrier = motion.pose_at(times)[:, :3, 3]
    people = np.stack([mover.pose_at(times)[:, :3, 3] for mover in world.movers])
    apart = np.linalg.norm((people - carrier)[..., :2], axis=2)
    assert apart[:, 0].max() < 13.0
    assert np.median(apart[:, 0]) < 6.0
    beside = apart[:COMPANIONS, times > 3.5]
    assert np.ptp(beside, axis=1).max() < 1.0
    assert beside.max() < 8.5
    assert apart[:, times > 1.0].min() > world.route.free_side_m


@pytest.mark.parametrize("seed", [0, 1, 424])  # of the last, the first network is in two parts
def test_a_lap_takes_every_street_once_in_either_direction_and_corners_that_a_car_can_take(seed):
    nodes, tour = town.draw_drive(np.random.default_rng(seed))
    driven = Counter(pairwise([*tour, tour[0]]))
    streets = sorted({(min(pair), max(pair)) for pair in driven})
    assert driven == Counter([*streets, *(street[::-1] for street in streets)])
    assert set(tour) == set(range(len(nodes)))
    assert not any(before == after for before, after in zip(tour, [*tour[2:], *tour[:2]], strict=True))  # no turn round
    steps = nodes[tour] - np.roll(nodes[tour], 1, axis=0)
    assert 9_000.0 < np.linalg.norm(steps, axis=1).sum() < 13_000.0
    assert len(streets) < 60
    assert np.bincount(np.ravel(streets)).min() >= 2
    for node in range(len(nodes)):
        ends = [nodes[b if a == node else a] - nodes[node] for a, b in streets if node in (a, b)]
        angles = np.sort([np.arctan2(y, x) for x, y in ends])
        assert np.diff([*angles, angles[0] + 2.0 * np.pi]).min() > np.deg2rad(40.0)


@pytest.mark.slow
def test_a_car_goes_round_and_round_and_nothing_stands_in_its_way(monkeypatch):
    monkeypatch.setattr(town, "_ROWS", 3)
    monkeypatch.setattr(town, "_LEFT_OUT", 2)
    small_town = town.town(0)
    lane = subdivide_loop(small_town.route.waypoints, 1.0)
    clear = Caster(small_town).distances(lane + np.array([0.0, 0.0, town.FREE_SIDE_M]))
    assert clear.min() > town.FREE_SIDE_M - 0.6  # over the ground's own unevenness
    assert len(small_town.boxes) > 1000
    assert (small_town.cylinders.radii == 0.33).sum() > 20  # wheels
    assert small_town.movers
    motion = motion_along_route("car-fast", small_town, 0)
    way = np.linalg.norm(np.diff(motion.base[:, :2], axis=0), axis=1)
    assert way.max() * (len(way) / motion.duration_s) < 14.5
    start, again = motion.pose_at(np.array([0.0, motion.duration_s]))
    assert np.allclose(start, again, atol=0.02)  # but for its suspension
