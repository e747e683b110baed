"""Sparse submaps and their bird's-eye views: turned, moved and tilted, places are recognised; others are not."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, make_transform, transform_points
from lidarslam.mapping.loops.birds_eye_view import BirdsEyeView, align, compare
from lidarslam.mapping.loops.sparse_submap import LINE, PLANE, SparseSubmap, _level_rotation

from .runs import assert_near
from .shapes import on_boxes

RADIUS_M = 16.0
UPSIDE_DOWN = exp([np.pi, 0, 0, 0, 0, 0])


def scene(seed: int) -> FloatArray:
    """Points (N, 3) of a hall of 24 x 16 x 4 m in which a dozen boxes stand, by seed."""
    rng = np.random.default_rng(seed)
    boxes = [((0, 0, 2), (12, 8, 2))]
    boxes += [((*rng.uniform((-10, -6), (10, 6)), 1.0), (*rng.uniform(0.3, 1.5, 2), 1.0)) for _ in range(12)]
    return on_boxes(boxes, 0.02, rng)


def pose(x: float, y: float, yaw_deg: float) -> FloatArray:
    return make_transform(exp([0, 0, np.deg2rad(yaw_deg), 0, 0, 0])[:3, :3], [x, y, 1.5])


def submap(points_world: FloatArray, T_world_lidar: FloatArray):
    return SparseSubmap.of(transform_points(inverse(T_world_lidar), points_world), 60.0)


@pytest.fixture(scope="module")
def hall() -> FloatArray:
    return scene(1)


HOME = pose(0.5, 0.3, 0.0)


def test_a_place_is_found_among_others(hall):
    places = [scene(seed) for seed in range(2, 30)] + [hall]
    descriptors = np.stack([BirdsEyeView.of(submap(place, HOME)).descriptor(RADIUS_M) for place in places])
    query = BirdsEyeView.of(submap(hall, pose(2.0, -0.9, 130.0))).descriptor(RADIUS_M)
    scores, _ = compare(query, descriptors)
    assert scores.argmax() == 28
    assert descriptors[0].nbytes < 6_500


@pytest.mark.parametrize("T_target_source", [pose(1.5, -2.0, 24.0), pose(-3.0, 1.0, -160.0)])
def test_laid_over_one_another(hall, T_target_source):
    true = T_target_source.copy()
    true[2, 3] = 0.4
    target, source = submap(hall, HOME), submap(hall, HOME @ true)
    target, source = BirdsEyeView.of(target), BirdsEyeView.of(source)
    _, turn = compare(source.descriptor(RADIUS_M), target.descriptor(RADIUS_M)[None])
    T, score = align(target, source, turn[0] + np.array([0.0, np.pi]), RADIUS_M)
    assert_near(T, true, 0.6, 4.0)
    assert 0.5 < score <= 1.0


def test_of_repeated_places_the_expected_one_counts():
    pillars = np.concatenate([[[4.0 * i, s * 3.0, 0.0]] for i in range(-6, 7) for s in (-1, 1)])
    points = pillars.repeat(80, axis=0)
    points += np.random.default_rng(0).uniform(-0.2, 0.2, points.shape) * [1, 1, 8]
    target = source = BirdsEyeView(points[:, :2], points[:, 2], np.eye(3))
    for x in (-4.0, 0.0, 4.0):
        T, _ = align(target, source, np.zeros(1), RADIUS_M, np.array([x + 0.5, 0.0]), 3.0)
        assert T[0, 3] == pytest.approx(x, abs=0.6)


@pytest.mark.parametrize("tilt_deg", [0.0, 30.0])
@pytest.mark.parametrize("upside_down", [False, True])
def test_the_sensor_is_stood_upright(hall, tilt_deg, upside_down):
    mounted = HOME @ UPSIDE_DOWN if upside_down else HOME
    T = mounted @ exp([0.3 * np.deg2rad(tilt_deg), np.deg2rad(tilt_deg), 0, 0, 0, 0])
    level = submap(hall, T).R_level_lidar
    up = level @ T[:3, :3].T @ [0.0, 0.0, 1.0]
    assert up == pytest.approx([0.0, 0.0, -1.0 if upside_down else 1.0], abs=0.03)
    assert level @ level.T == pytest.approx(np.eye(3), abs=1e-9)


def test_without_floor_the_sensor_is_taken_as_upright():
    assert _level_rotation(np.tile([1.0, 0.0, 0.0], (100, 1))) == pytest.approx(np.eye(3))
    assert _level_rotation(np.empty((0, 3))) == pytest.approx(np.eye(3))


def test_shapes_of_what_points_lie_on():
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-6, 6, (6000, 2)), np.full(6000, -1.5)])
    pole = np.column_stack([np.full((400, 2), 3.0), rng.uniform(-1.2, 3.0, 400)])
    wire = np.column_stack([rng.uniform(-6, 6, 800), np.full(800, -4.0), np.full(800, 2.0)])
    found = SparseSubmap.of(np.concatenate([floor, pole, wire]), 60.0)
    z, at_pole = found.points[:, 2], np.abs(found.points[:, :2] - 3.0).max(axis=1) < 0.01
    assert (found.kinds[z < -1.49] == PLANE).mean() > 0.95
    assert (found.axes[(z < -1.49) & (found.kinds == PLANE), 2] > 0.99).all()  # towards the sensor
    assert (found.kinds[at_pole & (z > -0.5)] == LINE).all()
    assert (np.abs(found.axes[at_pole & (z > -0.5), 2]) > 0.99).all()
    assert (found.kinds[z == 2.0] == 0).all()  # a single ring of a sensor looks like this


def test_the_range_image_holds_the_nearest_range_without_points_out_of_range_or_not_finite():
    points = np.array([[4.0, 0.01, 0.01], [6.0, 0.015, 0.015], [0.0, -7.0, 0.01]])
    found = SparseSubmap.of(points, 60.0)
    image = found.range_image
    assert found.nearest_ranges(np.array([[9.0, 0.02, 0.02], [5.0, 5.0, 0.0]])) == pytest.approx([4.0, 0.0], abs=0.01)
    assert sorted(image[image > 0.0].tolist()) == pytest.approx([4.0, 7.0], abs=0.01)
    points = np.array([[0.1, 0.0, 0.0], [5.0, 0.0, 0.0], [np.nan, 1.0, 1.0], [99.0, 0.0, 0.0], [np.inf, 0.0, 0.0]])
    assert SparseSubmap.of(points, 60.0).points == pytest.approx(np.array([[5.0, 0.0, 0.0]]))


@pytest.mark.parametrize("count", [0, 1, 8])
def test_nearly_empty_submaps_have_a_descriptor(count):
    tiny = SparseSubmap.of(np.random.default_rng(0).uniform(-4, 4, (count, 3)), 60.0)
    descriptor = BirdsEyeView.of(tiny).descriptor(RADIUS_M)
    assert np.isfinite(descriptor).all()
    T, _ = align(BirdsEyeView.of(tiny), BirdsEyeView.of(tiny), np.zeros(1), RADIUS_M)
    assert np.isfinite(T).all()


def test_memory_of_a_submap_is_bounded():
    points = np.random.default_rng(0).uniform(-30, 30, (60_000, 3))
    found = SparseSubmap.of(points, 60.0)
    assert len(found) == 2500
    assert sum(array.nbytes for array in vars(found).values() if isinstance(array, np.ndarray)) < 70_000
