"""The course of training, and what validation says of networks whose errors are known."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from lidarslam.odometry.config import TrainingConfig
from lidarslam.odometry.network.networks import CorrelationNetwork, PairEstimate, PairImages
from lidarslam.odometry.training.losses import learning_rate, make_optimizer, objective, validate
from lidarslam.odometry.training.pairs import birds, pair_of
from lidarslam.odometry.training.preparation import PreparedRecording

from .motions import torch_exp as exp

TWIST = (0.0, 0.0, 0.8, 2.0, 0.6, 0.2)


@pytest.mark.parametrize(("step", "rate"), [(0, 1e-4), (4, 5e-4), (9, 1e-3), (10, 1e-3), (60, 0.505e-3), (110, 1e-5)])
def test_the_learning_rate_rises_and_falls(step, rate):
    schedule = TrainingConfig(learning_rate=1e-3, warmup_steps=10, steps=110)
    assert learning_rate(step, schedule) == pytest.approx(rate, rel=1e-9)


def test_a_few_steps_bring_the_loss_down(small_room):
    torch.manual_seed(0)
    network = CorrelationNetwork()
    config = TrainingConfig(learning_rate=3e-3, geometric=None)
    optimizer = make_optimizer(network, config)
    pair = pair_of(small_room.recording(2, TWIST), 0, 1)
    turn = torch.atan2(pair.T_prev_curr[0, 1, 0], pair.T_prev_curr[0, 0, 0])
    pair = replace(pair, birds=birds(pair.scans, torch.tensor([[0.0, turn]]), torch.ones(1, 2)))
    generator = torch.Generator().manual_seed(0)
    losses = []
    for _ in range(12):
        losses.append(objective(network(pair), pair, config, generator))
        optimizer.zero_grad()
        losses[-1].total.backward()
        optimizer.step()
    assert losses[-1].turn < 0.8 * losses[0].turn
    assert losses[-1].shift < 0.8 * losses[0].shift


class Stub(nn.Module):
    """Knows the truth by the number of the scan, which it finds in the first pixel, and errs by what it is told."""

    def __init__(self, errors: Tensor, log_sigma: float) -> None:
        super().__init__()
        self.errors, self.log_sigma = errors, log_sigma

    def forward(self, pairs: PairImages) -> PairEstimate:
        assert pairs.scans.dtype == torch.float32  # recordings may keep halves
        previous, current = pairs.scans[:, :, 0, 0, 0].unbind(1)
        truth = exp(0.1 * (current - previous)[:, None] * torch.tensor([TWIST]))
        T = exp(self.errors[previous.long()]) @ truth
        none = torch.zeros(len(T), 0)
        return PairEstimate(T, torch.full((len(T), 6), self.log_sigma), none, none[..., None])


def numbered(count: int, small_room) -> PreparedRecording:
    recording = small_room.recording(2, TWIST)
    points = torch.arange(count, dtype=torch.float32)[:, None, None, None].expand(count, 3, 4, 8)
    T = recording.T_prev_curr.expand(count - 1, 4, 4)
    images = points, points.half(), torch.zeros(count, 4, 8)
    return PreparedRecording(*images, torch.ones(count - 1), T, torch.ones(count - 1) > 0)


def known_errors(count: int) -> Tensor:
    """(count, 6): 1, 2, 3, ... degrees about y, and as many centimetres along z."""
    errors = torch.zeros(count, 6)
    errors[:, 1] = torch.deg2rad(torch.arange(1.0, count + 1.0))
    errors[:, 5] = 0.01 * torch.arange(1.0, count + 1.0)
    return errors


def test_validation_tells_known_errors(small_room):
    recording = numbered(6, small_room)  # five pairs, with errors of 1 to 5
    found = validate(Stub(known_errors(6), math.log(0.02)), [recording])
    assert found.pairs == 5
    assert (found.rotation_rms_deg, found.rotation_median_deg) == pytest.approx((math.sqrt(11.0), 3.0), rel=1e-4)
    assert found.translation_rms_m == pytest.approx(0.01 * math.sqrt(11.0), rel=1e-4)
    assert found.translation_median_m == pytest.approx(0.03, rel=1e-4)
    # Of 5 x 6 errors 20 are zero. One sigma holds 1 degree (17 mrad), 1 cm and (just) 2 cm; two sigma (40 mrad) 2
    # degrees and up to 4 cm; three sigma 3 degrees (52 mrad) and all 5 cm.
    sigma = 0.02 * 1.001
    found = validate(Stub(known_errors(6), math.log(sigma)), [recording])
    assert found.covered_percent == pytest.approx([100.0 * (20 + n) / 30 for n in (1 + 2, 2 + 4, 3 + 5)])


def test_validation_is_over_all_recordings(small_room):
    recordings = [numbered(6, small_room), numbered(20, small_room), numbered(2, small_room)]
    found = validate(Stub(known_errors(20), 0.0), recordings)
    assert found.pairs == 5 + 19 + 1
    squares = sum(n * n for n in range(1, 6)) + sum(n * n for n in range(1, 20)) + 1
    assert found.rotation_rms_deg == pytest.approx(math.sqrt(squares / 25.0), rel=1e-4)


def test_without_a_valid_pair_there_is_no_number(small_room):
    doubted = replace(numbered(3, small_room), valid=torch.zeros(2, dtype=torch.bool))
    for recordings in ([doubted], []):
        found = validate(Stub(known_errors(6), 0.0), recordings)
        assert found.pairs == 0
        assert math.isnan(found.rotation_rms_deg)
        assert all(math.isnan(share) for share in found.covered_percent)
