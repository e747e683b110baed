"""What the default network must give whatever its weights are."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from lidarslam.odometry.config import NetworkConfig
from lidarslam.odometry.images import bird_eye
from lidarslam.odometry.images.bird_eye import SHIFTS
from lidarslam.odometry.network.networks import (
    INPUT_CHANNELS,
    CorrelationNetwork,
    PairImages,
    column_channels,
    make_network,
)
from lidarslam.odometry.network.torch_geometry import inverse, log
from lidarslam.odometry.training.config import TrainingConfig
from lidarslam.odometry.training.losses import objective
from lidarslam.odometry.training.pairs import PairBatch, birds, pair_of, rotate_columns

COLUMNS = 96
FEATURE_COLUMNS = COLUMNS // 4
TWIST = (0.0, 0.0, 1.0, 2.0, 0.5, 0.0)


def make(seed: int = 0) -> CorrelationNetwork:
    torch.manual_seed(seed)
    return CorrelationNetwork().eval()


@pytest.fixture(scope="module")
def network() -> CorrelationNetwork:
    return make()


@pytest.fixture(scope="module")
def scans(small_room) -> tuple[Tensor, Tensor]:
    """Points and normals (3, 3, H, W) each."""
    points, normals, _ = small_room.images(3, TWIST)
    return points, normals


def turned(scans: tuple[Tensor, Tensor], columns: int) -> tuple[Tensor, Tensor]:
    """The scans turned about z to the left by so many feature columns."""
    points, normals = (rotate_columns(images, torch.full((len(images),), 4 * columns)) for images in scans)
    return points, normals


def pairs(previous: tuple[Tensor, Tensor], current: tuple[Tensor, Tensor], turn: float = 0.0) -> PairImages:
    """Pairs of scans, the current ones turned by so much where they are seen from above."""
    one, other = torch.cat(previous, dim=1), torch.cat(current, dim=1)
    none = torch.zeros(len(one))
    return PairImages(one, other, birds(one, none), birds(other, none + turn))


def test_the_size_is_the_documented_one(network):
    assert sum(p.numel() for p in network.parameters()) == 62_005


@pytest.mark.parametrize("columns", [1, 7, -3])
def test_input_channels_know_no_azimuth(scans, columns):
    channels = column_channels(*scans)
    assert channels.shape == (3, INPUT_CHANNELS, 16, COLUMNS)
    shifted = column_channels(*(rotate_columns(images, torch.full((len(images),), columns)) for images in scans))
    torch.testing.assert_close(shifted, channels.roll(columns, -1), rtol=0, atol=2e-5)


@pytest.mark.parametrize("columns", [1, 5, -11])
@torch.no_grad()
def test_turning_a_scan_shifts_its_features(network, scans, columns):
    features = network.columns(*scans)
    assert features.shape == (3, 32, 4, FEATURE_COLUMNS)
    torch.testing.assert_close(features.norm(dim=1), torch.ones(3, 4, FEATURE_COLUMNS))
    shifted = network.columns(*turned(scans, columns))
    torch.testing.assert_close(shifted, features.roll(columns, -1), rtol=0, atol=1e-4)
    assert not torch.allclose(shifted, features, rtol=0, atol=0.01)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("columns", [0, 1, -1, 5, -7, 12])
@torch.no_grad()
def test_a_pure_turn_is_read_off_exactly(scans, columns, seed):
    """A sensor that turns to the left sees the scan turned to the right; the motion between is to the left."""
    network = make(seed)
    previous, current = network.columns(*scans), network.columns(*turned(scans, -columns))
    scores = network.turn_scores(previous, current)
    assert scores.shape == (3, FEATURE_COLUMNS)
    assert scores.argmax(1).tolist() == [columns % FEATURE_COLUMNS] * 3
    torch.testing.assert_close(scores, network.turn_scores(previous, previous).roll(columns, 1), rtol=0, atol=1e-4)


@pytest.mark.parametrize(("x", "y"), [(0, 0), (3, -2), (-11, 7), (18, -18)])
@torch.no_grad()
def test_a_pure_shift_is_read_off_exactly(network, x, y):
    """A sensor that goes forwards sees everything come nearer; the motion is forwards."""
    generator = torch.Generator().manual_seed(1)
    cells, reach = bird_eye.CELLS, 20
    previous = torch.zeros(1, 8, cells, cells)
    inner = slice(cells // 2 - reach, cells // 2 + reach)
    previous[:, :, inner, inner] = torch.randn(1, 8, 2 * reach, 2 * reach, generator=generator)
    scores = network.shift_scores(previous, previous.roll((-y, -x), (2, 3)))
    assert scores.shape == (1, SHIFTS, SHIFTS)
    assert divmod(int(scores.argmax()), SHIFTS) == (y + bird_eye.MOST_CELLS, x + bird_eye.MOST_CELLS)


@torch.no_grad()
def test_turn_and_shift_are_what_the_objective_asks_for(network, scans):
    """The signs of the scores are those of the losses that train them."""
    angle = 5 * 2.0 * math.pi / FEATURE_COLUMNS
    T = torch.eye(4).repeat(3, 1, 1)
    T[:, 0, 0] = T[:, 1, 1] = math.cos(angle)
    T[:, 1, 0], T[:, 0, 1] = math.sin(angle), -math.sin(angle)
    shift = torch.tensor([2.0, -1.0])
    T[:, :2, 3] = shift
    estimate = network(pairs(scans, turned(scans, -5), angle))
    moved = network(PairImages(*_shifted_grids(scans, (4, -2))))

    def losses(target: Tensor) -> tuple[float, float]:
        empty = torch.zeros(3, 6, 16, COLUMNS)
        batch = PairBatch(empty, empty, T_prev_curr=target, valid=torch.ones(3, dtype=torch.bool))
        config, generator = TrainingConfig(geometric=None), torch.Generator()
        return float(objective(estimate, batch, config, generator).turn), float(
            objective(moved, batch, config, generator).shift
        )

    right, wrong = losses(T), losses(inverse(T))
    assert right[0] < wrong[0] - 0.03
    assert right[1] < wrong[1]


def _shifted_grids(scans: tuple[Tensor, Tensor], cells: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Images of the scans twice, and their grids, the current ones as seen from so many cells along x and y."""
    images = torch.cat(scans, dim=1)
    grids = birds(images, torch.zeros(len(images)))
    return images, images, grids, grids.roll((-cells[1], -cells[0]), (2, 3))


@torch.no_grad()
def test_items_of_a_batch_do_not_see_each_other(network, scans):
    both = network(pairs(tuple(x[:2] for x in scans), tuple(x[1:] for x in scans)))
    for item in range(2):
        alone = network(pairs(tuple(x[item : item + 1] for x in scans), tuple(x[item + 1 : item + 2] for x in scans)))
        for name, value in vars(alone).items():
            torch.testing.assert_close(getattr(both, name)[item], value[0], rtol=0, atol=1e-4)


@torch.no_grad()
def test_empty_scans_give_a_finite_answer(network):
    nothing = torch.zeros(1, 3, 16, COLUMNS), torch.zeros(1, 3, 16, COLUMNS)
    assert all(value.isfinite().all() for value in vars(network(pairs(nothing, nothing))).values())


def test_the_default_objective_reaches_every_parameter(small_room):
    network = make().train()
    pair = pair_of(small_room.recording(3, TWIST), 0, 1)
    grids = birds(pair.previous, torch.zeros(1)), birds(pair.current, torch.zeros(1))
    batch = replace(pair, bird_previous=grids[0], bird_current=grids[1])
    loss = objective(network(batch), batch, TrainingConfig(), torch.Generator().manual_seed(0))
    loss.total.backward()  # type: ignore[no-untyped-call]
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name


@pytest.mark.parametrize("name", ["correlation", "delora"])
@torch.no_grad()
def test_every_network_takes_pairs(name, scans):
    torch.manual_seed(0)
    network = make_network(NetworkConfig(name=name)).eval()
    estimate = network(pairs(tuple(x[:2] for x in scans), tuple(x[1:] for x in scans)))
    assert log(estimate.T_prev_curr).isfinite().all()
    assert estimate.log_sigma.shape == (2, 6)
    assert len(estimate.turn_scores) == len(estimate.shift_scores) == 2
    if name == "delora":
        torch.testing.assert_close(estimate.log_sigma.exp(), torch.full((2, 6), 0.1))
