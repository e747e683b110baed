"""Motion compensation against the exponential map, point by point, and against a sweep of known truth."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp
from lidarslam.mapping.motion.deskew import Sweep, body_velocity, deskew


def exponentials(points: FloatArray, offsets: FloatArray, velocity: FloatArray) -> FloatArray:
    moved = [exp(offset * velocity)[:3] @ [*point, 1.0] for point, offset in zip(points, offsets, strict=True)]
    return np.array(moved)


@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e-7, 0.0])
def test_equals_the_exponential_of_every_points_time(rng, scale):
    points = rng.normal(0.0, 10.0, (200, 3))
    offsets = rng.uniform(-0.1, 0.1, 200)
    velocity = np.array([3.0 * scale, -2.0 * scale, 5.0 * scale, 10.0, 2.0, -1.0])
    expected = exponentials(points, offsets, velocity)
    np.testing.assert_allclose(deskew(points, offsets, velocity, velocity), expected, atol=1e-9)


@pytest.mark.parametrize(("low", "high"), [(-0.05, 0.05), (0.0, 0.1)])
def test_points_before_and_after_the_stamp_move_with_their_own_velocity(rng, low, high):
    points, offsets = rng.normal(0.0, 10.0, (200, 3)), rng.uniform(low, high, 200)
    before, after = rng.normal(size=(2, 6))
    expected = np.where(
        offsets[:, None] < 0.0, exponentials(points, offsets, before), exponentials(points, offsets, after)
    )
    np.testing.assert_allclose(deskew(points, offsets, before, after), expected, atol=1e-9)


def test_a_velocity_makes_its_motion_in_its_time(rng):
    velocity = rng.normal(size=6)
    np.testing.assert_allclose(body_velocity(exp(0.3 * velocity), 0.3), velocity, atol=1e-9)


@pytest.mark.parametrize("stamp_at", [0.0, 0.5, 1.0])
def test_a_sweep_of_a_sensor_that_turns_ever_faster_is_even_afterwards(room, stamp_at):
    """As on a walking robot: 20 deg/s faster at the end of the sweep than at its beginning."""
    velocity, acceleration = np.array([0.1, 0.5, 0.2, 1.0, 0.2, 0.0]), np.array([1.0, 3.5, -1.0, 0.0, 0.0, 0.0])

    def T_room_lidar_at(times: FloatArray) -> FloatArray:
        return exp(times[:, None] * velocity + 0.5 * times[:, None] ** 2 * acceleration)

    scan, middle_s = room.sweep(T_room_lidar_at, 0.0, stamp_at), 0.1 * (0.5 - stamp_at)
    sweep, mean = Sweep(scan.points, scan.time_offsets), velocity + middle_s * acceleration
    assert room.distance_to_surface(sweep.evened(acceleration[:3], middle_s).compensated(mean)).max() < 0.002
    assert room.distance_to_surface(sweep.compensated(mean)).max() > 0.02, "not so without"
