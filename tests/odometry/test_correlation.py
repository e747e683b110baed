"""What the default network must give whatever its weights are."""

import math

import pytest
import torch
from pydantic import ValidationError
from torch import Tensor

from odometry.correlation import INPUT_CHANNELS, CorrelationNetwork, column_channels
from odometry.evidence import PACKED_CHANNELS
from odometry.network_config import CorrelationConfig, NetworkConfig
from odometry.networks import make_network
from odometry.objective import objective
from odometry.pairs import PairBatch, pair_of
from odometry.torch_geometry import inverse, log, rotation_angle
from odometry.torch_images import RecordedImages, rotate_columns
from odometry.training import loss_of
from odometry.training_config import TrainingConfig

COLUMNS = 96
FEATURE_COLUMNS = COLUMNS // 4


def make(seed: int = 0, **options: object) -> CorrelationNetwork:
    torch.manual_seed(seed)
    return CorrelationNetwork(CorrelationConfig.model_validate(options))


@pytest.fixture(scope="module")
def network() -> CorrelationNetwork:
    return make()


@pytest.fixture(scope="module")
def scans(small_room) -> tuple[Tensor, Tensor]:
    """Points and normals (3, 3, H, W) each."""
    images = RecordedImages.stacked(small_room.sweeps(3, (0.0, 0.0, 1.0, 2.0, 0.5, 0.0)))
    return images.points, images.normals


def turned(scans: tuple[Tensor, Tensor], columns: int) -> tuple[Tensor, Tensor]:
    """The scans turned about z to the left by so many feature columns."""
    points, normals = (rotate_columns(images, 4 * columns) for images in scans)
    return points, normals


def yaw_deg(T: Tensor) -> Tensor:
    return torch.atan2(T[:, 1, 0], T[:, 0, 0]).rad2deg()


def test_the_size_is_the_documented_one(network):
    assert sum(p.numel() for p in network.parameters()) == 765_253


@pytest.mark.parametrize("columns", [1, 7, -3])
def test_input_channels_know_no_azimuth(scans, columns):
    channels = column_channels(*scans)
    assert channels.shape == (3, INPUT_CHANNELS, 16, COLUMNS)
    shifted = column_channels(*(rotate_columns(images, columns) for images in scans))
    torch.testing.assert_close(shifted, channels.roll(columns, -1), rtol=0, atol=2e-5)


def test_input_channels_are_about_one_and_empty_pixels_are_zero(scans):
    assert column_channels(*scans).abs().max() < 4.0
    empty = column_channels(torch.zeros(1, 3, 16, COLUMNS), torch.zeros(1, 3, 16, COLUMNS))
    assert not empty.any()


@pytest.mark.parametrize("columns", [1, 5, -11])
@torch.no_grad()
def test_turning_a_scan_shifts_its_features(network, scans, columns):
    features = network.encode(*scans)
    assert features.shape == (3, 64 + PACKED_CHANNELS, 4, FEATURE_COLUMNS)
    shifted = network.encode(*turned(scans, columns))
    torch.testing.assert_close(shifted, features.roll(columns, -1), rtol=0, atol=1e-4)
    assert not torch.allclose(shifted, features, rtol=0, atol=0.1)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("columns", [0, 1, -1, 5, -7, 12])
@torch.no_grad()
def test_a_pure_turn_is_read_off_exactly(scans, columns, seed):
    """A sensor that turns to the left sees the scan turned to the right; the motion between is to the left."""
    network = make(seed)
    previous, current = network.encode(*scans), network.encode(*turned(scans, -columns))
    estimate = network(previous, current)
    assert estimate.turn_scores.shape == (3, FEATURE_COLUMNS)
    assert estimate.turn_scores.argmax(1).tolist() == [columns % FEATURE_COLUMNS] * 3
    # What comes beyond whole columns is the same as for the scan on itself.
    on_itself = network(previous, previous)
    more = inverse(on_itself.T_prev_curr) @ estimate.T_prev_curr
    apart = (yaw_deg(more) - columns * 360.0 / FEATURE_COLUMNS).remainder(360.0)
    assert torch.minimum(apart, 360.0 - apart).max() < 0.01
    assert more[:, :3, 3].norm(dim=1).max() < 1e-4
    torch.testing.assert_close(estimate.log_sigma, on_itself.log_sigma, rtol=0, atol=1e-4)
    # And those are few at first: less than the two columns around the peak, with hardly a motion on top.
    assert rotation_angle(on_itself.T_prev_curr).rad2deg().max() < 2 * 360.0 / FEATURE_COLUMNS


@torch.no_grad()
def test_turning_both_scans_turns_the_scores_not_at_all(network, scans):
    previous, current = (tuple(images[i : i + 1] for images in scans) for i in (0, 1))
    as_is = network(network.encode(*previous), network.encode(*current))
    both = network(network.encode(*turned(previous, 5)), network.encode(*turned(current, 5)))
    torch.testing.assert_close(both.turn_scores, as_is.turn_scores, rtol=0, atol=1e-4)


@torch.no_grad()
def test_the_turn_is_what_the_objective_asks_for(network, scans):
    """The sign of the scores is that of the loss that trains them."""
    previous, current = network.encode(*scans), network.encode(*turned(scans, -5))
    estimate = network(previous, current)
    angle = torch.tensor(5 * 2.0 * math.pi / FEATURE_COLUMNS)
    T = torch.eye(4).repeat(3, 1, 1)
    T[:, 0, 0] = T[:, 1, 1] = angle.cos()
    T[:, 1, 0], T[:, 0, 1] = angle.sin(), -angle.sin()

    def turn_loss(target: Tensor) -> float:
        empty = torch.zeros(3, 6, 16, COLUMNS)
        batch = PairBatch(empty, empty, None, None, target, torch.ones(3, dtype=torch.bool))
        return float(objective(estimate, batch, TrainingConfig(geometric=None), torch.Generator()).turn)

    assert turn_loss(T) < turn_loss(inverse(T)) - 0.1


@torch.no_grad()
def test_items_of_a_batch_do_not_see_each_other(network, scans):
    features = network.encode(*scans)
    batch = network(features[:2], features[1:])
    for item in range(2):
        alone = network.encode(*(images[item : item + 2] for images in scans))
        estimate = network(alone[:1], alone[1:])
        for name in ("T_prev_curr", "log_sigma", "turn_scores"):
            torch.testing.assert_close(getattr(batch, name)[item], getattr(estimate, name)[0], rtol=0, atol=1e-5)


@pytest.mark.parametrize("gain", [1.0, 1e3, 1e5])
@torch.no_grad()
def test_outputs_are_rigid_and_confidence_is_bounded(scans, gain):
    network = make()
    for layer in (network.motion, network.confidence):
        layer.weight.mul_(gain)
    features = network.encode(*scans)
    estimate = network(features[:2], features[1:])
    R = estimate.T_prev_curr[:, :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3).expand(2, 3, 3), rtol=0, atol=1e-5)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(2), rtol=0, atol=1e-5)
    assert torch.equal(estimate.T_prev_curr[:, 3], torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(2, 4))
    assert estimate.log_sigma.min() >= -7.0
    assert estimate.log_sigma.max() <= 3.0
    if gain == 1e5:
        assert {-7.0, 3.0} & set(estimate.log_sigma.flatten().tolist())
    if gain == 1.0:
        torch.testing.assert_close(estimate.log_sigma, torch.full((2, 6), -3.0), rtol=0, atol=0.1)


@torch.no_grad()
def test_empty_scans_give_a_finite_answer(network):
    nothing = network.encode(torch.zeros(1, 3, 16, COLUMNS), torch.zeros(1, 3, 16, COLUMNS))
    estimate = network(nothing, nothing)
    assert all(value.isfinite().all() for value in vars(estimate).values())


@torch.no_grad()
def test_half_precision_does_not_reach_the_motion(network, scans):
    """Three digits are enough for features, not for a rotation."""
    exact = network(network.encode(*scans), network.encode(*turned(scans, -5)))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        estimate = network(network.encode(*scans), network.encode(*turned(scans, -5)))
    assert {value.dtype for value in vars(estimate).values()} == {torch.float32}
    R = estimate.T_prev_curr[:, :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3).expand(3, 3, 3), rtol=0, atol=1e-5)
    assert estimate.turn_scores.argmax(1).tolist() == exact.turn_scores.argmax(1).tolist()
    assert rotation_angle(estimate.T_prev_curr @ inverse(exact.T_prev_curr)).rad2deg().max() < 0.1


def test_the_default_objective_reaches_every_parameter(small_room):
    network = make()
    pair = pair_of(small_room.recording(2, (0.0, 0.0, 1.0, 2.0, 0.5, 0.0)), 0, 1)
    loss = loss_of(network, pair, TrainingConfig(), torch.Generator().manual_seed(0))
    loss.total.backward()  # type: ignore[no-untyped-call]
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().max() > 0.0, name


def test_the_alignment_reaches_the_scores_through_the_peak(small_room):
    """Without the loss on the turns themselves."""
    network = make()
    pair = pair_of(small_room.recording(2, (0.0, 0.0, 1.0, 2.0, 0.5, 0.0)), 0, 1)
    loss = loss_of(network, pair, TrainingConfig(geometric=None), torch.Generator().manual_seed(0))
    (gradient,) = torch.autograd.grad(loss.alignment, network.sharpness)
    assert gradient != 0.0


@torch.no_grad()
def test_other_sizes(scans):
    network = make(rows=8, widths=(8, 16, 24), pair_width=16, reach=2)
    half = tuple(images[:, :, ::2] for images in scans)
    features = network.encode(*half)
    assert features.shape == (3, 24 + PACKED_CHANNELS, 2, FEATURE_COLUMNS)
    assert network(features[:2], features[1:]).T_prev_curr.shape == (2, 4, 4)
    with pytest.raises(ValidationError, match="multiple of 4"):
        CorrelationConfig(rows=10)


@pytest.mark.parametrize("name", ["correlation", "delora"])
@torch.no_grad()
def test_every_network_takes_scans_first_and_pairs_then(name, scans):
    torch.manual_seed(0)
    network = make_network(NetworkConfig(name=name)).eval()
    features = network.encode(*scans)
    estimate = network(features[:2], features[1:])
    assert log(estimate.T_prev_curr).isfinite().all()
    assert estimate.log_sigma.shape == (2, 6)
    assert len(estimate.turn_scores) == 2
    if name == "delora":
        torch.testing.assert_close(estimate.log_sigma.exp(), torch.full((2, 6), 0.1))
        torch.testing.assert_close(features[:, 3], scans[0].norm(dim=1))
