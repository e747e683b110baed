"""Motion compensation against the exponential map, point by point, and against a sweep of known truth."""

from typing import Any

import numpy as np
import pytest

from lidarslam.core.geometry import exp, inverse
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from mapping.deskew import deskew


@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e-7, 0.0])
def test_equals_the_exponential_of_every_points_time(rng: np.random.Generator, scale: float) -> None:
    points = rng.normal(0.0, 10.0, (200, 3))
    offsets = rng.uniform(-0.1, 0.1, 200)
    xi = np.array([0.3 * scale, -0.2 * scale, 0.5 * scale, 1.0, 0.2, -0.1])
    expected = [exp(offset / 0.1 * xi)[:3] @ [*point, 1.0] for point, offset in zip(points, offsets, strict=True)]
    np.testing.assert_allclose(deskew(points, offsets, exp(xi), 0.1), expected, atol=1e-9)


def test_straightens_the_walls_of_a_room(room: Any, room_scans: list[Scan], room_truth: Trajectory) -> None:
    scan, T_room_lidar = room_scans[5], room_truth.T_world_lidar[5]
    T_prev_curr = inverse(room_truth.T_world_lidar[4]) @ T_room_lidar
    assert scan.time_offsets is not None
    straight = deskew(scan.points, scan.time_offsets, T_prev_curr, 0.1)
    for points, limit in ((straight, 1e-9), (scan.points, None)):
        in_room = points @ T_room_lidar[:3, :3].T + T_room_lidar[:3, 3]
        error = room.distance_to_surface(in_room).max()
        assert error < limit if limit else error > 0.05, "compensated exactly; not so without"


def test_nothing_to_do_without_points_or_without_an_interval(rng: np.random.Generator) -> None:
    points = rng.normal(size=(4, 3))
    assert deskew(points, np.zeros(4), exp([0.1] * 6), 0.0) is points
    assert len(deskew(np.empty((0, 3)), np.empty(0), exp([0.1] * 6), 0.1)) == 0
