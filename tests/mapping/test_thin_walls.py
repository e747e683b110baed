"""Walls thinner than a cell: each side is matched by those who see it, wherever the cells' borders are."""

from collections.abc import Sequence

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, make_transform
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.registration.local_map import Correspondences
from lidarslam.mapping.registration.sampled_scan import sizes_of_cells
from lidarslam.mapping.surfels.grid import MEAN, NORMAL, SurfelGrid
from lidarslam.mapping.surfels.surfel_map import SurfelMap
from lidarslam.mapping.surfels.voxel_hash import OTHER_SIDE, VoxelHash, key_cells, point_keys

from .shapes import across_x

CELL = 0.5
NOISE_M = 0.005
SENSORS = (np.array([0.0, 0.0, 0.0]), np.array([4.0, 0.0, 0.0]))
OFFSETS = np.arange(4) / 4.0
NEAR_SIDE, FAR_SIDE = (-1.0, 0.0, 0.0), (1.0, 0.0, 0.0)  # whence one sees them
ONE_AFTER_THE_OTHER, IN_TURNS = [0] * 20 + [1] * 20, [0, 1] * 20


def show(grid: SurfelGrid, points: FloatArray, view: Sequence[float]) -> None:
    """Points (N, 3), seen along one direction, by lasers at the height of the sensor."""
    grid.insert(points, np.zeros(len(points)), np.tile(view, (len(points), 1)))


def seen_wall(rng: np.random.Generator, cell_m: float, faces: tuple[float, float], sides: list[int]) -> SurfelMap:
    """A map of a wall with faces at these x, of which scan after scan saw one side."""
    local_map, half_size = SurfelMap(sizes_of_cells(cell_m), 100.0), 6.0 * cell_m
    for side in sides:
        points = across_x(rng, faces[side], half_size, 1_000)
        local_map.match(points, make_transform(np.eye(3), SENSORS[side]))  # as a scan is before it is added
        points[:, 0] += rng.normal(0.0, NOISE_M, len(points))
        local_map.insert(points, rng.uniform(-0.3, 0.3, len(points)), SENSORS[side])
    return local_map


def first_matches(local_map: SurfelMap, points: FloatArray, side: int) -> Correspondences:
    matcher = local_map.matcher(Sweep(points))
    matcher.match(points, make_transform(np.eye(3), SENSORS[side]))
    found = matcher.correspondences()
    _, first = np.unique(found.index, return_index=True)
    return Correspondences(*(column[first] for column in vars(found).values()))


def matched(rng: np.random.Generator, local_map: SurfelMap, x: float, side: int) -> tuple[float, FloatArray]:
    """The share of points on a face that are matched from one side, and how far these are off."""
    asked = across_x(rng, x, 4.0 * local_map.cell_m, 500)
    matches = first_matches(local_map, asked, side)
    return len(matches) / len(asked), np.abs(matches.residuals(asked[matches.index]))


@pytest.mark.parametrize("sides", [ONE_AFTER_THE_OTHER, IN_TURNS], ids=["one after the other", "in turns"])
@pytest.mark.parametrize(("cell_m", "thickness_m"), [(0.07, 0.03), (0.25, 0.10), (0.5, 0.03)])
def test_each_side_of_a_wall_within_a_cell_pulls_those_who_see_it(rng, cell_m, thickness_m, sides):
    off: list[FloatArray] = []
    for offset in OFFSETS * cell_m:
        faces = 2.0 + offset, 2.0 + offset + thickness_m
        local_map = seen_wall(rng, cell_m, faces, sides)
        for side in (0, 1):
            share, residuals = matched(rng, local_map, faces[side], side)
            assert share > 0.97
            off.append(residuals)
    together = np.concatenate(off)
    assert together.mean() < 0.004
    assert np.percentile(together, 90) < 0.005


@pytest.mark.parametrize("factor", [0.5, 2.2])
def test_both_sides_stay_when_cells_change_their_size(rng, factor):
    cell_m, faces = 0.25, (2.03, 2.13)
    resized = seen_wall(rng, cell_m, faces, ONE_AFTER_THE_OTHER).resized(sizes_of_cells(cell_m * factor))
    for side in (0, 1):
        asked = across_x(rng, faces[side], 2.0 * cell_m, 500)
        matches = first_matches(resized, asked, side)
        assert len(matches) > 0.95 * len(asked)
        assert np.abs(matches.residuals(asked[matches.index])).mean() < 0.005


def grid_of_both_sides(rng: np.random.Generator, count: int = 4_000) -> tuple[SurfelGrid, FloatArray, FloatArray]:
    """A wall within cells, and points of both its faces."""
    grid, faces = SurfelGrid(CELL), [across_x(rng, x, 1.4, count) for x in (2.1, 2.2)]
    for points, view in zip(faces, (NEAR_SIDE, FAR_SIDE), strict=True):
        show(grid, points, view)
    return grid, *faces


def test_another_side_takes_cells_only_where_it_was_seen(rng):
    both, near, far = grid_of_both_sides(rng)
    one = SurfelGrid(CELL)
    for seed in range(5):
        noisy = near + np.random.default_rng(seed).normal(0.0, 0.02, near.shape) * [1.0, 0.0, 0.0]
        show(one, noisy, NEAR_SIDE)
    cells = len(np.unique(np.floor(near / CELL), axis=0))
    assert len(one) == cells
    half = far[far[:, 1] > 0.0]
    show(one, half, FAR_SIDE)
    assert len(one) == cells + len(np.unique(np.floor(half / CELL), axis=0))
    assert len(both) == 2 * cells


def test_a_floor_passed_at_a_flat_angle_has_one_side_and_from_below_another(rng):
    """Seen from ahead and from behind the views are opposed, and yet it is the same surface."""
    grid = SurfelGrid(CELL)
    for view in ([0.98, 0.0, 0.2], [-0.98, 0.0, 0.2], [0.0, -0.98, 0.2]):
        floor = across_x(rng, 0.2, 1.4, 4_000)[:, [1, 2, 0]]
        show(grid, floor, view)
    cells = len(np.unique(np.floor(floor / CELL), axis=0))
    assert len(grid) == cells
    show(grid, floor - [0.0, 0.0, 0.1], [0.8, 0.0, -0.6])
    assert len(grid) == 2 * cells
    for sensor, z in ((np.array([0.0, 0.0, 5.0]), 0.2), (np.array([0.0, 0.0, -5.0]), 0.1)):
        heights = grid.surfels(grid.find(floor, sensor))[:, MEAN][:, 2]
        np.testing.assert_allclose(heights, z, atol=1e-5)


def test_a_wall_seen_along_from_one_end_still_has_two_sides(rng):
    """Views of both sides, and of neighbours, differ by less than a right angle."""
    grid, faces = SurfelGrid(CELL), [across_x(rng, x, 1.4, 4_000) for x in (2.1, 2.2)]
    for points, view in zip(faces, ([-0.4, 0.9, 0.0], [0.4, 0.9, 0.0]), strict=True):
        show(grid, points, view)
    for points, sensor, x in ((faces[0], [-1.0, 7.0, 0.0], 2.1), (faces[1], [5.0, 7.0, 0.0], 2.2)):
        surfels = grid.surfels(grid.find(points, np.array(sensor)))
        np.testing.assert_allclose(surfels[:, MEAN][:, 0], x, atol=1e-5)


def test_what_stays_of_both_sides_is_found_when_the_rest_is_forgotten(rng):
    grid, near, far = grid_of_both_sides(rng)
    before = [grid.surfels(grid.find(p, s)) for p, s in ((near, SENSORS[0]), (far, SENSORS[1]))]
    held = len(grid)
    grid.drop_beyond(np.array([2.15, 0.0, 0.0]), 1.0)
    assert 0 < len(grid) < held
    for points, sensor, values in zip((near, far), SENSORS, before, strict=True):
        inner = np.abs(points[:, 1:]).max(axis=1) < 0.5
        np.testing.assert_array_equal(grid.surfels(grid.find(points[inner], sensor)), values[inner])


def test_a_side_whose_first_side_was_a_stray_is_the_cells_only_one(rng):
    """Seen from there again it grows, and no third one begins."""
    grid, count = SurfelGrid(CELL), 60_000
    for x, points, view in ((2.1, 300, NEAR_SIDE), (2.2, count, FAR_SIDE)):
        show(grid, across_x(rng, x, 2.9, points), view)
    assert len(grid) > len(np.unique(key_cells(grid.state()["_keys"]), axis=0))
    grid.tidy()
    cells = key_cells(grid.state()["_keys"])
    assert len(grid) == len(np.unique(cells, axis=0))
    far = across_x(rng, 2.2, 2.4, count)
    surfels = grid.surfels(grid.find(far))
    np.testing.assert_allclose(surfels[:, NORMAL][:, 0], 1.0, atol=1e-3)
    show(grid, far, FAR_SIDE)
    assert len(grid) == len(cells)


def test_the_other_side_of_the_farthest_cell_is_no_free_slot():
    table, keys = VoxelHash(), point_keys(np.full((1, 3), 1e12), CELL) | OTHER_SIDE
    table.insert(keys)
    table.insert(keys)
    assert len(table) == 1
    assert table.find(keys).tolist() == [0]
