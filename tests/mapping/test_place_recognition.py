"""Places drawn from above: turned, moved, tilted and upside down, they are recognised; others are not."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, make_transform, rotation_angle, transform_points
from mapping.loops.descriptor import Drawing, Expected, Places, lay_over
from mapping.loops.place import LINE, PLANE, level_rotation, make_patch

RADIUS_M = 16.0
UPSIDE_DOWN = exp([np.pi, 0, 0, 0, 0, 0])


def scene(seed: int) -> FloatArray:
    """Points (N, 3) of a hall of 24 x 16 x 4 m in which a dozen boxes stand, by seed."""
    rng = np.random.default_rng(seed)
    boxes = [((0, 0, 2), (12, 8, 2))]
    boxes += [((*rng.uniform((-10, -6), (10, 6)), 1.0), (*rng.uniform(0.3, 1.5, 2), 1.0)) for _ in range(12)]
    parts = []
    for centre, half in boxes:
        c, h = np.array(centre), np.array(half)
        for axis in range(3):
            u, v = [a for a in range(3) if a != axis]
            for side in (-1.0, 1.0):
                p = rng.uniform(-1.0, 1.0, (int(4.0 * h[u] * h[v] / 0.02), 3)) * h
                p[:, axis] = side * h[axis]
                parts.append(c + p)
    return np.concatenate(parts)


def pose(x: float, y: float, yaw_deg: float) -> FloatArray:
    return make_transform(exp([0, 0, np.deg2rad(yaw_deg), 0, 0, 0])[:3, :3], [x, y, 1.5])


def patch(points_world: FloatArray, T_world_lidar: FloatArray):
    return make_patch(transform_points(inverse(T_world_lidar), points_world), 0.5, 60.0, 30.0, 2500)


def similarity(first, second, upside_down: bool = False) -> tuple[float, float]:
    places = Places()
    places.add(Drawing.of(first).signature(RADIUS_M))
    found, turn = places.compare(Drawing.of(second, upside_down).signature(RADIUS_M), np.array([0]))
    return float(found[0]), float(turn[0])


@pytest.fixture(scope="module")
def hall() -> FloatArray:
    return scene(1)


HOME = pose(0.5, 0.3, 0.0)


@pytest.mark.parametrize("yaw_deg", [0.0, 37.0, 90.0, 150.0, -60.0, 180.0])
def test_the_turn_is_found_whatever_it_is(hall, yaw_deg):
    score, turn = similarity(patch(hall, HOME), patch(hall, pose(0.5, 0.3, yaw_deg)))
    off = np.rad2deg(turn) - yaw_deg
    assert abs((off + 90.0) % 180.0 - 90.0) <= 3.0
    assert score > 0.7


def test_itself_is_alike_in_full(hall):
    score, turn = similarity(patch(hall, HOME), patch(hall, HOME))
    assert score == pytest.approx(1.0, abs=1e-5)
    assert turn == 0.0


def test_a_place_is_found_among_others(hall):
    places = Places()
    for seed in range(2, 30):
        places.add(Drawing.of(patch(scene(seed), HOME)).signature(RADIUS_M))
    places.add(Drawing.of(patch(hall, HOME)).signature(RADIUS_M))
    query = Drawing.of(patch(hall, pose(2.0, -0.9, 130.0))).signature(RADIUS_M)
    scores, _ = places.compare(query, np.arange(len(places)))
    assert scores.argmax() == 28
    only_others, _ = places.compare(query, np.array([3, 7]))
    assert np.allclose(only_others, scores[[3, 7]], atol=1e-5)


def test_many_places_keep_their_order_and_their_size(hall):
    places = Places()
    signatures = [Drawing.of(patch(scene(seed), HOME)).signature(RADIUS_M) for seed in (1, 2, 3)]
    for i in range(150):
        places.add(signatures[i % 3])
    scores, _ = places.compare(signatures[1], np.arange(150))
    assert (np.flatnonzero(scores > 0.999) % 3 == 1).all()
    assert (scores > 0.999).sum() == 50
    assert places.nbytes / 150 < 6_500


@pytest.mark.parametrize("T_target_source", [pose(1.5, -2.0, 24.0), pose(-3.0, 1.0, -160.0), pose(0.0, 2.5, 93.0)])
def test_laid_over_one_another(hall, T_target_source):
    true = T_target_source.copy()
    true[2, 3] = 0.4
    target, source = patch(hall, HOME), patch(hall, HOME @ true)
    _, turn = similarity(target, source)
    T, score = lay_over(Drawing.of(target), Drawing.of(source), turn + np.array([0.0, np.pi]), RADIUS_M)
    error = inverse(true) @ T
    assert np.linalg.norm(error[:3, 3]) < 0.6
    assert np.rad2deg(rotation_angle(error)) < 4.0
    assert 0.5 < score <= 1.0


def test_of_repeated_places_the_expected_one_counts():
    pillars = np.concatenate([[[4.0 * i, s * 3.0, 0.0]] for i in range(-6, 7) for s in (-1, 1)])
    points = pillars.repeat(80, axis=0) + np.random.default_rng(0).uniform(-0.2, 0.2, (80 * len(pillars), 3)) * [
        1,
        1,
        8,
    ]
    target = source = Drawing(points[:, :2], points[:, 2], np.eye(3))
    for x in (-4.0, 0.0, 4.0):
        T, _ = lay_over(target, source, np.zeros(1), RADIUS_M, Expected(np.array([x + 0.5, 0.0]), 3.0))
        assert T[0, 3] == pytest.approx(x, abs=0.6)


@pytest.mark.parametrize("tilt_deg", [0.0, 15.0, 30.0])
@pytest.mark.parametrize("upside_down", [False, True])
def test_the_sensor_is_stood_upright(hall, tilt_deg, upside_down):
    T = (
        HOME
        @ (UPSIDE_DOWN if upside_down else np.eye(4))
        @ exp([0.3 * np.deg2rad(tilt_deg), np.deg2rad(tilt_deg), 0, 0, 0, 0])
    )
    level = patch(hall, T).R_level_lidar
    up = level @ T[:3, :3].T @ [0.0, 0.0, 1.0]
    assert up == pytest.approx([0.0, 0.0, -1.0 if upside_down else 1.0], abs=0.03)
    assert level @ level.T == pytest.approx(np.eye(3), abs=1e-9)


def test_without_floor_the_sensor_is_taken_as_upright():
    assert level_rotation(np.tile([1.0, 0.0, 0.0], (100, 1))) == pytest.approx(np.eye(3))
    assert level_rotation(np.empty((0, 3))) == pytest.approx(np.eye(3))


def test_a_sensor_that_hangs_upside_down_sees_the_same_place(hall):
    hanging = pose(1.0, -0.8, 70.0) @ UPSIDE_DOWN
    target, source = patch(hall, HOME), patch(hall, hanging)
    score, turn = similarity(target, source, upside_down=True)
    assert score > 0.7
    assert score > similarity(target, source)[0] + 0.1
    T, _ = lay_over(Drawing.of(target), Drawing.of(source, True), turn + np.array([0.0, np.pi]), RADIUS_M)
    error = inverse(inverse(HOME) @ hanging) @ T
    assert np.linalg.norm(error[:3, 3]) < 0.6
    assert np.rad2deg(rotation_angle(error)) < 4.0


def test_shapes_of_what_points_lie_on():
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-6, 6, (6000, 2)), np.full(6000, -1.5)])
    pole = np.column_stack([np.full((400, 2), 3.0), rng.uniform(-1.2, 3.0, 400)])
    wire = np.column_stack([rng.uniform(-6, 6, 800), np.full(800, -4.0), np.full(800, 2.0)])
    found = make_patch(np.concatenate([floor, pole, wire]), 0.5, 60.0, 30.0, 2500)
    z, at_pole = found.points[:, 2], np.abs(found.points[:, :2] - 3.0).max(axis=1) < 0.01
    assert (found.kinds[z < -1.49] == PLANE).mean() > 0.95
    assert (found.axes[(z < -1.49) & (found.kinds == PLANE), 2] > 0.99).all()  # towards the sensor
    assert (found.kinds[at_pole & (z > -0.5)] == LINE).all()
    assert (np.abs(found.axes[at_pole & (z > -0.5), 2]) > 0.99).all()
    assert (found.kinds[z == 2.0] == 0).all()  # a single ring of a sensor looks like this


def test_sight_holds_the_nearest_range():
    points = np.array([[4.0, 0.01, 0.01], [6.0, 0.015, 0.015], [0.0, -7.0, 0.01]])
    sight = make_patch(points, 0.5, 60.0, 30.0, 2500).sight
    assert sorted(sight[sight > 0.0].tolist()) == pytest.approx([4.0, 7.0], abs=0.01)


def test_points_out_of_range_or_not_finite_are_left_out():
    points = np.array([[0.1, 0.0, 0.0], [5.0, 0.0, 0.0], [np.nan, 1.0, 1.0], [99.0, 0.0, 0.0], [np.inf, 0.0, 0.0]])
    assert make_patch(points, 0.5, 60.0, 30.0, 2500).points == pytest.approx(np.array([[5.0, 0.0, 0.0]]))


@pytest.mark.parametrize("count", [0, 1, 8])
def test_nearly_empty_submaps_have_a_signature(count):
    tiny = make_patch(np.random.default_rng(0).uniform(-4, 4, (count, 3)), 0.5, 60.0, 30.0, 2500)
    signature = Drawing.of(tiny).signature(RADIUS_M)
    assert np.isfinite(signature).all()
    T, _ = lay_over(Drawing.of(tiny), Drawing.of(tiny), np.zeros(1), RADIUS_M)
    assert np.isfinite(T).all()


def test_memory_of_a_patch_is_bounded():
    points = np.random.default_rng(0).uniform(-30, 30, (60_000, 3))
    found = make_patch(points, 0.5, 60.0, 30.0, 2500)
    assert len(found) == 2500
    assert found.nbytes < 70_000
