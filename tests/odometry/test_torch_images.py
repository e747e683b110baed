"""Images of sweeps in torch, compensated for a motion that is known."""

import math

import pytest
import torch

from odometry.training.torch_geometry import exp, transform_points
from odometry.training.torch_images import RecordedImages, compensate, compensated

SLOW = (0.05, -0.05, 0.1, 1.0, 0.3, 0.1)
TURNING = (0.0, 0.0, math.radians(120.0), 1.0, 0.3, 0.0)


@pytest.mark.parametrize("is_direction", [False, True])
def test_compensation_is_the_exponential_to_second_order(is_direction):
    g = torch.Generator().manual_seed(3)
    points = torch.nn.functional.normalize(torch.randn(1, 500, 3, generator=g, dtype=torch.float64), dim=-1)
    offsets = 0.1 * torch.rand(1, 500, generator=g, dtype=torch.float64) - 0.05
    axis = torch.nn.functional.normalize(torch.randn(3, generator=g, dtype=torch.float64), dim=0)
    v = torch.tensor([2.0, -1.0, 0.5], dtype=torch.float64)
    for turn_deg, accuracy in ((10.0, 1.2e-4), (20.0, 9.5e-4)):
        velocity = torch.cat([axis * math.radians(turn_deg) / 0.1, v])[None]
        T = exp(offsets[0, :, None] * velocity)  # (N, 4, 4)
        exact = transform_points(T, points[0, :, None])[:, 0]
        if is_direction:
            exact = exact - T[:, :3, 3]
        difference = (compensate(points, offsets, velocity, is_direction)[0] - exact).norm(dim=-1)
        assert difference.max() < accuracy
        assert difference.max() > 0.5 * accuracy  # else the docstring says too little


def test_a_compensated_sweep_is_what_would_be_seen_at_rest(box_room):
    """Its points lie on the walls as seen from the middle of the sweep; its times are gone."""
    raw = RecordedImages.stacked(box_room.sweeps(1, TURNING))
    still = compensated(raw, torch.tensor([TURNING]))
    assert not still.offsets.any()
    assert wall_distance(raw) > 0.2
    assert wall_distance(still) < 0.002
    along_axis = still.normals.abs().amax(1)[still.normals.square().sum(1) > 0.5]
    assert along_axis.min() > math.cos(math.radians(0.1))


def wall_distance(images):
    """The greatest distance, metres, of points with a normal along x or y from the walls of the room and its boxes."""
    x, y = images.points[:, 0], images.points[:, 1]
    sides = [
        (x, (-7.0, 7.0, 2.6, 3.4, -4.6, -3.4, -2.3, -1.7, 4.5, 5.5)),
        (y, (-5.0, 5.0, 1.6, 2.4, -3.6, -2.4, 3.2, 3.8, -2.5, -1.5)),
    ]
    normals = images.normals.abs()
    worst = 0.0
    for axis, (values, planes) in enumerate(sides):
        here = normals[:, axis] > 0.9
        worst = max(worst, float((values[here][:, None] - torch.tensor(planes)).abs().amin(1).max()))
    return worst


def test_compensation_back_and_forth_is_none(box_room):
    raw = RecordedImages.stacked(box_room.sweeps(2, TURNING))
    velocity = torch.tensor([TURNING, SLOW])
    still = compensated(raw, velocity)
    back = compensated(RecordedImages(still.points, still.normals, -raw.offsets, raw.low, raw.high), velocity)
    torch.testing.assert_close(back.points, raw.points, rtol=0, atol=3e-4)
    torch.testing.assert_close(back.normals, raw.normals, rtol=0, atol=4e-5)


def test_compensation_of_nothing_stays_nothing(box_room):
    full = RecordedImages.stacked(box_room.sweeps(1, TURNING))
    seen = torch.rand(1, 1, 16, 360, generator=torch.Generator().manual_seed(0)) < 0.5
    raw = RecordedImages(full.points * seen, full.normals * seen, full.offsets, full.low, full.high)
    empty = ~seen[:, 0]
    still = compensated(raw, torch.tensor([TURNING]))
    assert torch.equal(still.points.square().sum(1) == 0.0, empty)
    assert torch.equal(still.normals.square().sum(1) == 0.0, empty)
    assert torch.equal(compensated(raw, torch.zeros(1, 6)).points, raw.points)
