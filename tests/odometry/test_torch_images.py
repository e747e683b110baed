"""Images of sweeps in torch, compensated for a motion that is known."""

import math

import torch
from torch import Tensor

from lidarslam.odometry.training.pairs import compensated

TURNING = (0.0, 0.0, math.radians(120.0), 1.0, 0.3, 0.0)


def still(points: Tensor, normals: Tensor, offsets: Tensor, *velocities: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    return compensated(points, normals, offsets, torch.tensor(velocities))


def test_a_compensated_sweep_is_what_would_be_seen_at_rest(box_room):
    """Its points lie on the walls as seen from the middle of the sweep."""
    points, normals, offsets = box_room.images(1, TURNING)
    assert wall_distance(points, normals) > 0.2
    points, normals = still(points, normals, offsets, TURNING)
    assert wall_distance(points, normals) < 0.002
    along_axis = normals.abs().amax(1)[normals.square().sum(1) > 0.5]
    assert along_axis.min() > math.cos(math.radians(0.1))


def wall_distance(points: Tensor, normals: Tensor) -> float:
    """The greatest distance, metres, of points with a normal along x or y from the walls of the room and its boxes."""
    sides = [
        (points[:, 0], (-7.0, 7.0, 2.6, 3.4, -4.6, -3.4, -2.3, -1.7, 4.5, 5.5)),
        (points[:, 1], (-5.0, 5.0, 1.6, 2.4, -3.6, -2.4, 3.2, 3.8, -2.5, -1.5)),
    ]
    worst = 0.0
    for axis, (values, planes) in enumerate(sides):
        here = normals[:, axis].abs() > 0.9
        worst = max(worst, float((values[here][:, None] - torch.tensor(planes)).abs().amin(1).max()))
    return worst
