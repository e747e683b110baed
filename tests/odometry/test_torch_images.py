"""Images of sweeps in torch, compensated for a motion that is known."""

import math

import numpy as np
import torch
from torch import Tensor

from lidarslam.core.geometry import exp
from lidarslam.odometry.network.torch_geometry import transform_points
from lidarslam.odometry.training.pairs import compensated

SLOW = (0.05, -0.05, 0.1, 1.0, 0.3, 0.1)
TURNING = (0.0, 0.0, math.radians(120.0), 1.0, 0.3, 0.0)


def test_compensation_is_the_exponential_to_second_order():
    g = torch.Generator().manual_seed(3)
    points = torch.nn.functional.normalize(torch.randn(500, 3, generator=g, dtype=torch.float64), dim=-1)
    offsets = 0.1 * torch.rand(500, generator=g, dtype=torch.float64) - 0.05
    axis = torch.nn.functional.normalize(torch.randn(3, generator=g, dtype=torch.float64), dim=0)
    v = torch.tensor([2.0, -1.0, 0.5], dtype=torch.float64)
    for turn_deg, accuracy in ((10.0, 1.2e-4), (20.0, 9.5e-4)):
        velocity = torch.cat([axis * math.radians(turn_deg) / 0.1, v])
        T = torch.from_numpy(exp(np.multiply.outer(offsets.numpy(), velocity.numpy())))  # (N, 4, 4)
        exact = transform_points(T, points[:, None])[:, 0]
        image = points.T[None, :, None]  # (1, 3, 1, N)
        found = compensated(image, image, offsets[None, None], velocity[None])
        for moved, truth in zip(found, (exact, exact - T[:, :3, 3]), strict=True):
            difference = (moved[0, :, 0].T - truth).norm(dim=-1)
            assert difference.max() < accuracy
            assert difference.max() > 0.5 * accuracy  # else the docstring says too little


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


def test_compensation_back_and_forth_is_none(box_room):
    points, normals, offsets = box_room.images(2, TURNING)
    back = still(*still(points, normals, offsets, TURNING, SLOW), -offsets, TURNING, SLOW)
    torch.testing.assert_close(back[0], points, rtol=0, atol=3e-4)
    torch.testing.assert_close(back[1], normals, rtol=0, atol=4e-5)


def test_compensation_of_nothing_stays_nothing(box_room):
    there = torch.rand(1, 1, 16, 360, generator=torch.Generator().manual_seed(0)) < 0.5
    points, normals, offsets = box_room.images(1, TURNING)
    points, normals = points * there, normals * there
    for images in still(points, normals, offsets, TURNING):
        assert torch.equal(images.square().sum(1) == 0.0, ~there[:, 0])
    assert torch.equal(still(points, normals, offsets, (0.0,) * 6)[0], points)
