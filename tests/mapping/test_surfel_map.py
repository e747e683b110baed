"""Correspondences of points with surfaces that have formulas."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, make_transform
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.registration.local_map import Correspondences
from lidarslam.mapping.registration.sampled_scan import sizes_of_cells
from lidarslam.mapping.surfels.grid import SurfelGrid
from lidarslam.mapping.surfels.surfel_kernels import views_of
from lidarslam.mapping.surfels.surfel_map import SurfelMap

from .shapes import across_x, grass_on_a_slope, insert, on_sides, surfel_map_of

CELL = 0.4
CELLS = sizes_of_cells(CELL)
HALF = np.array([7.0, 5.0, 2.0])
HERE = np.eye(4)
CORNER = (4.0, 5.0)  # x and y of its walls


def floor_points(rng: np.random.Generator, count: int, half_size: float = 4.0, z: float = -1.0) -> FloatArray:
    return across_x(rng, z, half_size, count)[:, [1, 2, 0]]


def ring(elevation_deg: float, walls: tuple[float, float] | None = None, z: float = -1.0) -> FloatArray:
    """Where one laser meets two walls around a corner, at x and y, or the floor at height z."""
    azimuth = np.deg2rad(np.linspace(0.0, 90.0, 901)[1:-1])
    tangent = np.tan(np.deg2rad(elevation_deg))
    distance = np.full(len(azimuth), z / tangent)
    if walls is not None:
        distance = np.minimum(walls[0] / np.cos(azimuth), walls[1] / np.sin(azimuth))
    return np.column_stack([distance * np.cos(azimuth), distance * np.sin(azimuth), distance * tangent])


def distances(points: FloatArray, matches: Correspondences) -> FloatArray:
    offsets = points[matches.index] - matches.points
    return np.abs(np.einsum("ij,ij->i", offsets, matches.normals))


def test_points_on_walls_meet_the_walls(rng):
    local_map, asked = surfel_map_of(on_sides(rng, HALF, 40_000), CELL), on_sides(rng, HALF, 2_000, margin_m=2 * CELL)
    matches = local_map.match(asked, HERE)
    np.testing.assert_array_equal(np.sort(matches.index), np.arange(len(asked)))
    assert distances(asked, matches).max() < 1e-5
    assert matches.thickness_m.max() < 1e-3
    side = (np.abs(np.abs(asked) - HALF) < 1e-9).argmax(axis=1)[matches.index]
    np.testing.assert_allclose(np.abs(matches.normals[np.arange(len(side)), side]), 1.0, atol=1e-9)


def test_many_points_make_the_same_grids_as_each_grid_alone(rng):
    points, local_map = on_sides(rng, HALF, 40_000), SurfelMap(CELLS, 100.0)
    insert(local_map, points)
    alone = [SurfelGrid(cell_m) for cell_m in CELLS]
    for grid, other in zip(local_map.grids, alone, strict=True):
        other.insert(points, np.zeros(len(points)), views_of(points, np.zeros(3)))
        np.testing.assert_array_equal(grid.means(), other.means())


def test_where_fine_cells_show_nothing_coarse_ones_do(rng):
    asked = floor_points(rng, 300, half_size=3.0)
    matches = surfel_map_of(floor_points(rng, 150), CELL).match(asked, HERE)
    np.testing.assert_array_equal(np.sort(matches.index), np.arange(len(asked)))
    assert distances(asked, matches).max() < 1e-5


@pytest.mark.parametrize("first_level", range(len(CELLS)))
def test_coarse_grids_reach_farther(rng, first_level):
    """Alone they reach at least as far above the floor as their own cells, and not three times as far."""
    local_map = surfel_map_of(floor_points(rng, 40_000, z=-0.01), CELL)
    cell_m = CELLS[first_level]
    above = floor_points(rng, 100, half_size=1.0, z=0.9 * cell_m)
    assert len(local_map.match(above, make_transform(np.eye(3), [0.0, 0.0, 5.0]), first_level)) == 100
    beyond = above + np.array([0.0, 0.0, 3.0 * CELLS[-1]])
    assert len(local_map.match(beyond, make_transform(np.eye(3), [0.0, 0.0, 9.0]), first_level)) == 0


def test_finer_grids_are_left_out_on_request(rng):
    """Of floors half a coarse cell apart, fine cells show each, coarse ones something between."""
    low, high = floor_points(rng, 30_000, z=-1.0), floor_points(rng, 5_000, z=-1.0 + 3.2 * CELL)
    local_map = surfel_map_of(np.concatenate([low, high]), CELL)
    asked = floor_points(rng, 200, half_size=2.0)
    assert distances(asked, local_map.match(asked, HERE, 0)).max() < 1e-5
    assert distances(asked, local_map.match(asked, HERE, len(CELLS) - 1)).min() > 0.01


@pytest.mark.parametrize(("elevation_deg", "walls"), [(-4.0, CORNER), (0.5, CORNER), (8.0, CORNER), (-5.7, None)])
def test_a_ring_bent_around_a_corner_or_on_the_ground_is_no_plane(elevation_deg, walls):
    points = ring(elevation_deg, walls)
    assert len(surfel_map_of(points, CELL).match(points, HERE)) == 0


@pytest.mark.parametrize(("elevation_deg", "counts"), [(-15.0, True), (-1.0, False)])
def test_what_a_ring_draws_from_afar_as_the_sensor_pitches_is_no_plane(elevation_deg, counts):
    """The ground rises by 15 degrees where the pitch is off by ever more: no other ring contradicts that."""
    local_map = SurfelMap(CELLS, 100.0)
    for step in range(12):
        moved = np.array([0.08 * step, 0.0, 0.02 * step])
        points = ring(elevation_deg) + moved
        insert(local_map, points, moved)
    matched = len(np.unique(local_map.match(points, make_transform(np.eye(3), moved)).index))
    assert (matched > 0.8 * len(points)) == counts
    assert counts or matched == 0


def test_two_rings_on_walls_show_them():
    points = np.concatenate([ring(3.0, CORNER), ring(6.0, CORNER)])
    away = np.abs(points[:, 0] - points[:, 1] * 4.0 / 5.0) > 2.5  # from the corner
    matches = surfel_map_of(points, CELL).match(points[away], HERE)
    assert len(np.unique(matches.index)) > 0.9 * away.sum()
    assert distances(points[away], matches).max() < 1e-5


def test_the_map_stays_around_the_sensor(rng):
    floor, far = floor_points(rng, 20_000, half_size=3.0), np.array([30.0, 0.0, 0.0])
    local_map, away = surfel_map_of(floor, CELL, radius_m=20.0), floor + far
    insert(local_map, away, far)
    assert len(local_map.match(floor[:200], HERE)) == 0
    assert len(local_map.match(away[:200], make_transform(np.eye(3), far))) == 200


@pytest.mark.parametrize("factor", [0.45, 0.8, 2.0])
def test_planes_stay_in_place_when_cells_change_their_size(rng, factor):
    """By more than two it changes when the sensor leaves a hall for a corridor, or the other way round."""
    resized = surfel_map_of(on_sides(rng, HALF, 60_000), CELL).resized(sizes_of_cells(CELL * factor))
    assert resized.cell_m == CELL * factor
    asked = on_sides(rng, HALF, 2_000, margin_m=max(1.0, 2 * CELL * factor))
    matches = resized.match(asked, HERE)
    assert len(np.unique(matches.index)) > 0.95 * len(asked)
    off = distances(asked, matches)
    assert np.median(off) < 1e-3
    assert np.percentile(off, 90) < 0.03


def test_grazed_ground_is_still_known_when_cells_change_their_size(rng):
    azimuth, elevation_deg = rng.uniform(-np.pi, np.pi, 20_000), rng.uniform(-8.0, -4.0, 20_000)
    distance = 1.0 / np.tan(np.deg2rad(-elevation_deg))
    ground = np.column_stack([distance * np.cos(azimuth), distance * np.sin(azimuth), np.full(20_000, -1.0)])
    local_map = surfel_map_of(ground, CELL)
    maps = local_map, local_map.resized(sizes_of_cells(2.0 * CELL))
    before, after = (len(one.match(ground[:500], HERE)) for one in maps)
    assert after > 0.8 * before > 350


@pytest.mark.parametrize(("roll_deg", "pitch_deg"), [(0.0, 0.0), (10.0, 25.0), (-35.0, 0.0)])
def test_the_vertical_of_a_tilted_map_is_that_of_its_floor(rng, roll_deg, pitch_deg):
    R = exp(np.deg2rad([roll_deg, pitch_deg, 0.0, 0.0, 0.0, 0.0]))[:3, :3]
    vertical = surfel_map_of(on_sides(rng, HALF, 40_000) @ R.T, CELL).vertical()
    tilt_deg = np.hypot(roll_deg, pitch_deg)  # the corners of a room as small as this pull at it
    assert np.rad2deg(np.arccos(vertical @ R[:, 2])) < 1.0 + 0.16 * tilt_deg
    assert np.linalg.norm(vertical) == pytest.approx(1.0)
    wall = across_x(rng, 3.0, 3.0, 4_000)
    np.testing.assert_array_equal(surfel_map_of(wall, CELL).vertical(), [0.0, 0.0, 1.0])  # without a floor the world's


def test_in_grass_a_wider_plane_is_taken_and_with_an_imu_the_finest_of_a_young_map(rng):
    """Of blades of 20 cm, the finest cells have normals of any direction: here 1.6 degrees off.

    Few sweeps of few rings make planes of any direction in coarse cells.
    """
    points, normal = grass_on_a_slope(rng, 0.2)
    asked = points[np.abs(points[:, :2]).max(axis=1) < 4.0][:500]
    grass_map = surfel_map_of(points, CELL)
    matches = grass_map.match(asked, HERE)
    errors_deg = np.degrees(np.arccos(np.abs(matches.normals @ normal)))
    assert len(matches) == len(asked)
    assert np.median(errors_deg) < 0.6
    assert np.median(matches.tilt) < 0.01
    matcher = grass_map.matcher(Sweep(asked), is_inertial=True)
    matcher.match(asked, HERE)
    assert np.median(matcher.correspondences().tilt) > 0.02


@pytest.mark.parametrize("tidied_after", [1_000, 3])
def test_a_restored_map_that_has_forgotten_goes_on_to_the_last_bit(rng, through_disk, monkeypatch, tidied_after):
    """Rows of cells are in the order in which they came, also after some were dropped."""
    monkeypatch.setattr("lidarslam.mapping.surfels.surfel_map._TIDIED_AFTER", tidied_after)

    def add(local_map: SurfelMap, step: int) -> None:
        sensor = np.array([2.0 * step, 0.0, 0.0])
        insert(local_map, np.random.default_rng(step).uniform(-4.0, 4.0, (3000, 3)) + sensor, sensor)

    whole, restored = (SurfelMap(sizes_of_cells(0.3), 6.0) for _ in range(2))
    for step in range(4):
        add(whole, step)
    restored.restore(through_disk(whole.state()))
    assert len(restored) == len(whole)
    queries = rng.uniform(-4.0, 12.0, (2000, 3))
    for step in range(4, 8):
        add(whole, step)
        add(restored, step)
        found = restored.match(queries, np.eye(4))
        for name, value in vars(whole.match(queries, np.eye(4))).items():
            np.testing.assert_array_equal(getattr(found, name), value)


@pytest.mark.parametrize("are_sparse", [False, True])
def test_only_larger_cells_have_a_ceiling_that_one_scan_of_sparse_rings_sees_from_afar(are_sparse):
    """1 m above the sensor, at 3.7 m and more, where the rings are 0.6 m apart."""
    azimuth, elevation = np.meshgrid(np.deg2rad(np.arange(-14.0, 14.0, 0.4)), np.deg2rad([15.0, 13.0]))
    away = 1.0 / np.tan(elevation)
    ceiling = np.stack([away * np.cos(azimuth), away * np.sin(azimuth), np.ones_like(away)], axis=-1).reshape(-1, 3)
    local_map = SurfelMap(sizes_of_cells(0.05, are_sparse), 100.0)
    local_map.insert(ceiling, elevation.ravel(), np.zeros(3))
    planes = local_map.match(ceiling, HERE)
    assert len(planes) == are_sparse * len(ceiling)
    np.testing.assert_allclose(planes.normals[:, 2], -1.0, atol=1e-3)
