"""What two scans must show of a motion, block by block."""

import math

import pytest
import torch
from torch import Tensor

from odometry.evidence import BLOCK, EVIDENCE_CHANNELS, PACKED_CHANNELS, evidence, pack
from odometry.torch_images import RecordedImages, rotate_columns

ROWS, COLUMNS = 8, 48
FINE_WEIGHT, COARSE_WEIGHT = 6, 13  # channels


def ground(height: float, pitch: float = 0.0) -> tuple[Tensor, Tensor]:
    """Points and normals (1, 3, H, W) of a plane that passes so far above the sensor, turned about y."""
    elevation = torch.linspace(-0.6, -0.2, ROWS)[:, None]
    azimuth = ((torch.arange(COLUMNS) + 0.5) * (2.0 * math.pi / COLUMNS))[None]
    ray = torch.stack(torch.broadcast_tensors(
        elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin()
    ))  # fmt: skip
    normal = torch.tensor([math.sin(pitch), 0.0, math.cos(pitch)])[:, None, None]
    points = ray * (height * normal[2] / (ray * normal).sum(0))
    return points[None], normal.expand_as(points)[None]


def shown(previous: tuple[Tensor, Tensor], current: tuple[Tensor, Tensor]) -> Tensor:
    return evidence(pack(*previous), pack(*current))


def test_sizes():
    packed = pack(*ground(-1.0))
    assert packed.shape == (1, PACKED_CHANNELS, ROWS // BLOCK, COLUMNS // BLOCK)
    assert evidence(packed, packed).shape == (1, EVIDENCE_CHANNELS, ROWS // BLOCK, COLUMNS // BLOCK)


def test_a_scan_on_itself_shows_no_motion_and_that_it_fits():
    channels = shown(ground(-1.0), ground(-1.0))[0]
    still = [*range(6), *range(7, 13), *range(14, 17)]
    assert channels[still].abs().max() < 1e-5
    torch.testing.assert_close(channels[[FINE_WEIGHT, COARSE_WEIGHT]], torch.ones_like(channels[:2]))
    # The squares of normals that point up, from sixteen pixels and a bit.
    torch.testing.assert_close(channels[19], torch.full_like(channels[19], 16.0 / 17.0))
    assert channels[17:19].abs().max() < 1e-5


@pytest.mark.parametrize("rise", [0.05, -0.02])
def test_ground_that_is_nearer_speaks_for_a_motion_along_its_normal(rise):
    """The sensor sinks by `rise`: the points come up by that, whatever their distance."""
    channels = shown(ground(-1.0), ground(-1.0 + rise))[0]
    weight = 16.0 / (1.0 + (rise / 0.3) ** 2) ** 2
    torch.testing.assert_close(
        channels[2], torch.full_like(channels[2], weight * rise / ((weight + 1.0) * 0.3)), rtol=1e-3, atol=1e-5
    )
    assert channels[:2].abs().max() < 1e-5
    torch.testing.assert_close(channels[FINE_WEIGHT], torch.full_like(channels[2], weight / 16.0))


def test_a_pitch_is_the_first_harmonic_of_the_normals():
    """Normals lean outwards ahead and inwards behind."""
    pitch = 0.01
    channels = shown(ground(-1.0), ground(-1.0, pitch))[0]
    azimuth = (torch.arange(COLUMNS // BLOCK) + 0.5) * (2.0 * math.pi * BLOCK / COLUMNS)
    expected = 10.0 * pitch * azimuth.cos() * 16.0 / 17.0
    assert (channels[14] - expected).abs().max() < 0.05 * 10.0 * pitch
    # The angle about the sideways axis has its sign, and is seen ahead and behind.
    about = (channels[4] * azimuth.cos()).mean()
    assert about > 0.0


def test_what_is_far_from_the_other_surface_counts_at_the_coarse_scale_only():
    channels = shown(ground(-2.0), ground(-1.0))[0]
    assert channels[FINE_WEIGHT].max() < 0.01
    assert channels[COARSE_WEIGHT].min() > 0.5


def test_surfaces_turned_otherwise_are_not_compared():
    (points, normals), other = ground(-1.0), ground(-1.0)
    channels = shown((points, normals), (other[0], torch.roll(other[1], 1, dims=1)))
    assert not channels.any()


@pytest.mark.parametrize("cells", [1, 5, -3])
def test_turning_both_scans_shifts_it(small_room, cells):
    images = RecordedImages.stacked(small_room.sweeps(2, (0.02, 0.01, 0.0, 0.1, 0.05, 0.02)))
    scans = [(images.points[i : i + 1], images.normals[i : i + 1]) for i in (0, 1)]
    turned = [tuple(rotate_columns(values, BLOCK * cells) for values in scan) for scan in scans]
    before, after = shown(*scans), shown(*turned)
    assert before.abs().max() > 0.1
    torch.testing.assert_close(after, before.roll(cells, -1), rtol=0, atol=2e-4)


def test_empty_scans_show_nothing():
    nothing = torch.zeros(1, 3, ROWS, COLUMNS)
    assert not shown((nothing, nothing), ground(-1.0)).any()
    assert not shown(ground(-1.0), (nothing, nothing)).any()
