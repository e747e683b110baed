"""Maps of edges and planar points: their lines and planes, and registration to them, against known truth."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray, exp, inverse, log, transform_points
from lidarslam.mapping.loam.feature_map import FeatureMap
from lidarslam.mapping.loam.features import EDGE, PLANE
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.motion.prediction import Prediction
from lidarslam.mapping.registration.registration import are_large, register
from lidarslam.mapping.registration.sampled_scan import SampledScan, sizes_of_cells
from lidarslam.mapping.surfels.voxel_hash import point_keys

from .shapes import across_x, grass_on_a_slope, on_sides

ORIGIN = np.zeros(3)
CELL_M = 0.2
CELLS_M = sizes_of_cells(CELL_M)


def kinds_of(edges: FloatArray, planes: FloatArray) -> NDArray[np.int8]:
    return np.repeat(np.array([EDGE, PLANE], dtype=np.int8), [len(edges), len(planes)])


def add(feature_map: FeatureMap, edges: FloatArray, planes: FloatArray, sensor: FloatArray = ORIGIN) -> None:
    points = np.concatenate([edges, planes])
    sweep = Sweep(points, None, kinds_of(edges, planes))
    scan = SampledScan(0.0, feature_map.cells_m, 1.0, sweep, np.zeros(len(points)), sweep)
    feature_map.add(scan, points, sensor)


def map_of(edges: FloatArray, planes: FloatArray, cell_m: float = CELL_M, radius_m: float = 100.0) -> FeatureMap:
    feature_map = FeatureMap(sizes_of_cells(cell_m), radius_m)
    add(feature_map, edges, planes)
    return feature_map


NONE = np.empty((0, 3))


def test_voxels_beyond_the_radius_are_dropped_on_the_way(rng):
    points = rng.uniform(-10.0, 10.0, (2000, 3))
    feature_map = map_of(points[:500], points[500:], radius_m=8.0)
    sensor = np.array([5.0, 0.0, 0.0])
    add(feature_map, NONE, NONE, sensor)
    for grid in feature_map.grids:
        assert len(grid) > 0
        assert np.linalg.norm(grid.means - sensor, axis=1).max() < 8.0


def test_a_map_of_other_cells_has_the_same_points(rng):
    points = rng.uniform(-3.0, 3.0, (3000, 3))
    fine, coarse = map_of(points[:900], points[900:], 0.1), map_of(points[:900], points[900:], 0.4)
    resized = fine.resized(sizes_of_cells(0.4))
    assert fine.resized(sizes_of_cells(0.1)) is fine
    assert resized.scans == fine.scans
    for found, expected in zip(resized.grids, coarse.grids, strict=True):
        assert found._sums[:, 0].sum() == expected._sums[:, 0].sum()
        assert len(found) == pytest.approx(len(expected), rel=0.2)


def on_plane(rng: np.random.Generator, count: int, noise_m: float = 0.0) -> FloatArray:
    """Points of the plane z = 1."""
    return across_x(rng, 1.0, 3.0, count)[:, [1, 2, 0]] + noise_m * rng.standard_normal((count, 1)) * [0.0, 0.0, 1.0]


def test_a_plane_is_that_of_the_points_in_the_five_nearest_voxels(rng):
    points = on_plane(rng, 20_000, 0.01)
    feature_map, asked = map_of(NONE, points), on_plane(rng, 200)
    found = feature_map.match(asked, np.eye(4))
    np.testing.assert_array_equal(found.index, np.arange(200))
    grid = feature_map._planes[0]
    keys = point_keys(points, CELL_M)
    for row, near in enumerate(cKDTree(grid.means).query(asked, 5)[1]):
        members = points[np.isin(keys, grid._keys[near])]
        values, vectors = np.linalg.eigh(np.cov(members.T, bias=True))
        assert abs(found.normals[row] @ vectors[:, 0]) == pytest.approx(1.0, abs=1e-9)
        np.testing.assert_allclose(found.points[row], members.mean(axis=0), atol=1e-9)
        number, noise = len(members), 2.0 * 0.02**2
        variance = (number * values[0] + noise) / (number - 3 + 2)
        assert found.thickness_m[row] == pytest.approx(np.sqrt(variance * (1.0 + 120.0 / number)))
        assert found.tilt[row] == pytest.approx(np.sqrt(variance / (number * values[1])))


def test_a_plane_is_matched_from_the_side_it_was_seen_from_and_its_normal_faces_that(rng):
    points, asked = on_plane(rng, 20_000), on_plane(rng, 50)
    for z in (5.0, -5.0):
        feature_map = FeatureMap(CELLS_M, 100.0)
        add(feature_map, NONE, points, np.array([0.0, 0.0, z]))
        found = feature_map.match(asked, exp([0, 0, 0, 0, 0, z]))
        np.testing.assert_allclose(found.normals, np.tile([0.0, 0.0, np.sign(z - 1.0)], (50, 1)), atol=1e-6)
        assert len(feature_map.match(asked, exp([0, 0, 0, 0, 0, -z]))) == 0


def test_a_point_on_the_other_side_of_a_thin_wall_is_not_matched_to_this_one(rng):
    near, far = (across_x(rng, x, 1.0, 20_000) for x in (2.0, 2.12))
    feature_map, behind = map_of(NONE, near, 0.05), exp([0, 0, 0, 4.0, 0, 0])
    assert len(feature_map.match(far[::50], behind)) == 0
    add(feature_map, NONE, far, behind[:3, 3])
    found = feature_map.match(far[::50], behind)
    assert len(found) > 390
    assert np.abs(found.residuals(far[::50][found.index])).max() < 1e-6


def test_a_line_has_two_residuals_the_first_along_the_distance(rng):
    along = rng.uniform(-3.0, 3.0, 3000)
    edges = np.column_stack([along, np.full((3000, 2), [2.0, -1.0])]) + 0.005 * rng.standard_normal((3000, 3))
    asked = np.array([[0.5, 2.05, -1.0], [-0.7, 2.0, -0.9]])
    matcher = map_of(edges, NONE).matcher(Sweep(asked, None, np.full(2, EDGE, dtype=np.int8)))
    matcher.match(asked, np.eye(4))
    np.testing.assert_array_equal(matcher.surfaces.counts, 2)
    np.testing.assert_allclose(matcher.surfaces.normals[:, 0], [[0, 1, 0], [0, 0, 1]], atol=0.05)
    normals = matcher.surfaces.normals[:, :2]
    np.testing.assert_allclose(np.einsum("nki,nli->nkl", normals, normals), np.tile(np.eye(2), (2, 1, 1)), atol=1e-9)
    found = matcher.correspondences()
    np.testing.assert_allclose(np.abs(found.residuals(asked[found.index])[::2]), [0.05, 0.1], atol=0.01)


@pytest.mark.parametrize("held", [0, 4])
def test_fewer_than_five_voxels_make_no_plane(rng, held):
    middles = CELL_M * (np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])[:held] + 0.5)
    points = (middles[:, None] + rng.uniform(-0.05, 0.05, (held, 50, 3)) * [1, 1, 0]).reshape(-1, 3)
    assert len(map_of(NONE, points).match(middles, np.eye(4))) == 0


@pytest.mark.parametrize("heights_m", [[0.0], [0.0, 0.35]], ids=["one ring", "two rings"])
def test_the_plane_of_a_ring_s_beams_is_no_surface(rng, heights_m):
    """Of a wall seen by one ring, ranges scatter more than elevations."""
    count = 400 * len(heights_m)
    wall = np.column_stack([np.full(count, 10.0), rng.uniform(-2.0, 2.0, count), np.resize(heights_m, count)])
    beams = wall * (1.0 + 0.003 * rng.standard_normal((count, 1)))
    found = map_of(NONE, beams).match(wall[::20], np.eye(4))
    if len(heights_m) == 1:
        assert len(found) == 0
    else:
        assert len(found) > 30
        assert np.abs(found.normals[:, 0]).min() > 0.95


@pytest.mark.parametrize(("away_m", "half_m", "elevations", "is_found"), [
    (6.0, 0.08, [-0.28], False), (6.0, 0.3, [-0.28], True), (6.0, 0.08, [0.0], True),
    (12.0, 0.5, [-0.14], False), (12.0, 0.5, [-0.143, -0.137], False), (12.0, 0.5, [-0.148, -0.132], True),
], ids=["swept a little", "wide", "no rings", "one ring", "rings nearby", "rings"])  # fmt: skip
def test_the_plane_of_a_ring_that_was_swept_a_little_or_grazes_its_relief_is_none(
    rng, away_m, half_m, elevations, is_found
):
    """Six metres ahead, 0.1 degrees of attitude lift the floor by a centimetre; without elevations, there are no rings.

    Twelve metres ahead, rings that are 0.9 degrees apart differ in height by 0.2 m: relief along one is no surface.
    """
    n = 6000
    floor = np.column_stack([rng.uniform(-half_m, half_m, n) + away_m, rng.uniform(-2.0, 2.0, n), np.full(n, -1.7)])
    feature_map, sweep = FeatureMap(CELLS_M, 100.0), Sweep(floor, None, kinds_of(NONE, floor))
    feature_map.add(SampledScan(0.0, CELLS_M, 1.0, sweep, np.resize(elevations, n), sweep), floor, ORIGIN)
    asked = np.column_stack([np.full(50, away_m), rng.uniform(-1.5, 1.5, 50), np.full(50, -1.7)])
    assert len(feature_map.match(asked, np.eye(4))) == (50 if is_found else 0)


def test_across_a_corner_a_plane_is_uncertain(rng):
    sides = rng.uniform(0.0, 1.0, (2, 4000, 3)) * [1.0, 1.0, 2.0]
    sides[0, :, 0], sides[1, :, 1] = 0.0, 0.0
    feature_map = map_of(NONE, sides.reshape(-1, 3))
    found = feature_map.match(np.array([[0.01, 0.01, 1.0], [0.0, 0.7, 1.0]]), exp([0, 0, 0, 0.8, 0.6, 1.0]))
    thickness_m = np.full(2, np.inf)
    thickness_m[found.index] = found.thickness_m
    assert thickness_m[0] > 3.0 * thickness_m[1]


def test_where_the_finest_voxels_are_too_few_coarser_ones_have_the_plane(rng):
    feature_map, asked = map_of(NONE, on_plane(rng, 150, 0.005)), on_plane(rng, 50)
    assert len(feature_map.match(asked, np.eye(4), 2)) > 45
    found = feature_map.match(asked, np.eye(4))
    assert len(found) > 45
    assert np.abs(found.normals[:, 2]).min() > 0.98


# A hall of 12 x 9 x 5 m: its faces sampled away from their borders, and the lines where they meet, away from corners.
HALF = np.array([6.0, 4.5, 2.5])
BORDER_M = 0.7


def on_faces(rng: np.random.Generator, count: int) -> FloatArray:
    return on_sides(rng, HALF, count, margin_m=BORDER_M)


def on_lines(rng: np.random.Generator, count: int) -> FloatArray:
    points, axis = HALF * rng.choice([-1.0, 1.0], (count, 3)), np.arange(count) % 3
    points[np.arange(count), axis] = rng.uniform(-1.0, 1.0, count) * (HALF - BORDER_M)[axis]
    return points


T_TRUE = exp([0.02, -0.03, 0.4, 1.0, -0.5, 0.2])
CLOSE = exp([0.01, -0.015, 0.03, 0.12, -0.08, 0.05])  # of the prediction to the truth
COVARIANCE = np.diag([0.05**2] * 3 + [0.3**2] * 3 + [1e-6] * 6)


@pytest.mark.parametrize(("edges", "planes"), [(200, 600), (600, 0), (0, 600)])
def test_a_motion_is_found(rng, edges, planes):
    hall = map_of(on_lines(rng, 20_000), on_faces(rng, 60_000))
    seen = on_lines(rng, edges), on_faces(rng, planes)
    points = transform_points(inverse(T_TRUE), np.concatenate(seen))
    prediction = Prediction(0.0, T_TRUE @ CLOSE, np.zeros(6), COVARIANCE)
    found = register(Sweep(points, None, kinds_of(*seen)), prediction, hall, with_velocity=False)
    np.testing.assert_allclose(log(inverse(T_TRUE) @ found.T_world_lidar), 0.0, atol=1e-3)
    assert found.degeneracy.names == ()


def test_the_vertical_is_that_of_the_floor(rng):
    tilt = exp([0.1, 0.05, 0.0, 0.0, 0.0, 0.0])
    feature_map = map_of(NONE, transform_points(tilt, on_faces(rng, 60_000)))
    np.testing.assert_allclose(feature_map.vertical(), tilt[:3, 2], atol=0.01)


def test_large_surfaces_go_on(rng):
    faces = on_faces(rng, 60_000)
    person = np.array([1.0, 1.0, 0.0]) + rng.uniform(-1.0, 1.0, (600, 3)) * [0.2, 0.0, 0.2]
    feature_map = map_of(NONE, np.concatenate([faces, person]))
    floor, board = np.array([[2.0, 0.5, -2.5]]), np.array([[1.0, 1.0, 0.0]])
    assert are_large(feature_map, floor, np.array([[0.0, 0.0, 1.0]]), ORIGIN).all()
    assert not are_large(feature_map, floor, np.array([[0.0, 1.0, 0.0]]), ORIGIN).any()
    assert not are_large(feature_map, board, np.array([[0.0, 1.0, 0.0]]), ORIGIN).any()


def test_in_grass_a_wider_plane_is_taken(rng):
    """Through the finest voxels, planes are 2.1 degrees off."""
    points, normal = grass_on_a_slope(rng, 0.16)
    asked = points[np.abs(points[:, :2]).max(axis=1) < 4.0][:500]
    matches = map_of(NONE, points, 0.4).match(asked, np.eye(4))
    assert len(matches) == len(asked)
    assert np.median(np.degrees(np.arccos(np.abs(matches.normals @ normal)))) < 1.2
    assert np.median(matches.tilt) < 0.02
