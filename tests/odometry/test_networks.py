"""What the networks must give whatever their weights are."""

from dataclasses import replace
from functools import cache

import pytest
import torch
from torch import Tensor

from lidarslam.odometry.config import NetworkConfig, TrainingConfig
from lidarslam.odometry.images import bird_eye
from lidarslam.odometry.images.bird_eye import SHIFTS
from lidarslam.odometry.network.networks import CorrelationNetwork, DeloraNetwork, PairImages
from lidarslam.odometry.network.networks import make_network as network_named
from lidarslam.odometry.training.losses import objective
from lidarslam.odometry.training.pairs import birds, pair_of, rotate_columns

from .conftest import stacked

COLUMNS = 96
FEATURE_COLUMNS = COLUMNS // 4
TWIST = (0.0, 0.0, 1.0, 2.0, 0.5, 0.0)


@cache
def make(name: str, seed: int = 0):
    torch.manual_seed(seed)
    return network_named(NetworkConfig.model_validate({"name": name})).eval()


@pytest.fixture(scope="module")
def network() -> CorrelationNetwork:
    return make("correlation")


@pytest.fixture(scope="module")
def scans(small_room) -> tuple[Tensor, Tensor]:
    """Points and normals (3, 3, H, W) each."""
    points, normals, _ = stacked(small_room.sweeps(3, TWIST))
    return points, normals


def turned(scans: tuple[Tensor, Tensor], columns: int) -> tuple[Tensor, Tensor]:
    """The scans turned about z to the left by so many columns."""
    points, normals = (rotate_columns(images, torch.full((len(images),), columns)) for images in scans)
    return points, normals


def pairs(previous: tuple[Tensor, Tensor], current: tuple[Tensor, Tensor]) -> PairImages:
    """Pairs of scans, seen from above as they are."""
    both = torch.stack([torch.cat(previous, dim=1), torch.cat(current, dim=1)], dim=1)
    return PairImages(both, birds(both, torch.zeros(len(both), 2), torch.ones(len(both), 2)))


@pytest.mark.parametrize(("name", "count"), [("correlation", 62_005), ("delora", 11_876_019)])
def test_the_size_is_the_documented_one_and_the_papers(name, count):
    assert sum(p.numel() for p in make(name).parameters()) == count


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("columns", [0, 1, 5, -11])
@torch.no_grad()
def test_a_turn_shifts_the_features_and_is_read_off_exactly(scans, columns, seed):
    """A sensor that turns to the left sees the scan turned to the right; the motion between is to the left."""
    network = make("correlation", seed)
    previous, current = network.columns(*scans), network.columns(*turned(scans, -4 * columns))
    torch.testing.assert_close(previous.norm(dim=1), torch.ones(3, 4, FEATURE_COLUMNS))
    torch.testing.assert_close(current, previous.roll(-columns, -1), rtol=0, atol=1e-4)
    scores = network.turn_scores(previous, current)
    assert scores.argmax(1).tolist() == [columns % FEATURE_COLUMNS] * 3
    torch.testing.assert_close(scores, network.turn_scores(previous, previous).roll(columns, 1), rtol=0, atol=1e-4)


@pytest.mark.parametrize(("x", "y"), [(0, 0), (3, -2), (-11, 7), (18, -18)])
@torch.no_grad()
def test_a_pure_shift_is_read_off_exactly(network, x, y):
    """A sensor that goes forwards sees everything come nearer; the motion is forwards."""
    cells, reach = bird_eye.CELLS, 20
    previous = torch.zeros(1, 8, cells, cells)
    inner = slice(cells // 2 - reach, cells // 2 + reach)
    previous[:, :, inner, inner] = torch.randn(1, 8, 2 * reach, 2 * reach, generator=torch.Generator().manual_seed(1))
    scores = network.shift_scores(previous, previous.roll((-y, -x), (2, 3)))
    assert divmod(int(scores.argmax()), SHIFTS) == (y + bird_eye.MOST_CELLS, x + bird_eye.MOST_CELLS)


@torch.no_grad()
def test_the_first_scan_of_a_pair_is_the_previous_one(network, scans):
    pair, most = pairs(scans, turned(scans, -20)), bird_eye.MOST_CELLS
    grids = torch.stack([pair.birds[:, 0], pair.birds[:, 0].roll((2, -4), (2, 3))], dim=1)  # seen from x = 4, y = -2
    estimate = network(replace(pair, birds=grids))
    assert estimate.turn_scores.argmax(1).tolist() == [5] * 3
    assert (estimate.shift_scores[:, most - 2, most + 4] > estimate.shift_scores[:, most + 2, most - 4]).all()


@pytest.mark.parametrize("name", ["correlation", "delora"])
@torch.no_grad()
def test_answers_are_rigid_and_those_of_each_pair_alone(name, scans):
    network = make(name)
    both = network(pairs(tuple(x[:2] for x in scans), tuple(x[1:] for x in scans)))
    R = both.T_prev_curr[:, :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3).expand(2, 3, 3), rtol=0, atol=1e-6)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(2))
    assert both.log_sigma.shape == (2, 6)
    for item in range(2):
        alone = network(pairs(tuple(x[item : item + 1] for x in scans), tuple(x[item + 1 : item + 2] for x in scans)))
        for field, value in vars(alone).items():
            torch.testing.assert_close(getattr(both, field)[item], value[0], rtol=0, atol=1e-4)
    nothing = torch.zeros(1, 3, 16, COLUMNS), torch.zeros(1, 3, 16, COLUMNS)
    assert all(value.isfinite().all() for value in vars(network(pairs(nothing, nothing))).values())


@pytest.mark.parametrize("name", ["correlation", "delora"])
def test_the_objective_reaches_every_parameter(small_room, name):
    torch.manual_seed(0)
    network = network_named(NetworkConfig.model_validate({"name": name}))
    pair = pair_of(small_room.recording(3, TWIST), 0, 1)
    batch = replace(pair, birds=birds(pair.scans, torch.zeros(1, 2), torch.ones(1, 2)))
    loss = objective(network(batch), batch, TrainingConfig(), torch.Generator().manual_seed(0))
    loss.total.backward()  # type: ignore[no-untyped-call]
    for field, parameter in network.named_parameters():
        assert parameter.grad is not None, field
        assert parameter.grad.isfinite().all(), field


@torch.no_grad()
def test_azimuth_has_no_seam_in_delora():
    network: DeloraNetwork = make("delora")
    scans = 0.2 * torch.randn(2, 2, 6, 16, 128, generator=torch.Generator().manual_seed(4))

    def features(scans: Tensor) -> Tensor:
        """(B, 512, ceil(H/2), ceil(W/32)) before pooling."""
        ranges = scans[:, :, :3].norm(dim=2, keepdim=True)
        return network.stages(network.stem(torch.cat([scans[:, :, :3], ranges], dim=2).flatten(1, 2)))

    found, rolled = features(scans), scans.roll(64, dims=-1)
    torch.testing.assert_close(features(rolled), found.roll(2, dims=3), rtol=0, atol=1e-5)
    motions = [network(PairImages(images)).T_prev_curr for images in (scans, rolled)]
    torch.testing.assert_close(*motions, rtol=0, atol=1e-5)
    assert (found.roll(1, dims=3) - found).abs().max() > 1e-2  # or the comparison would say nothing
    assert (features(scans.roll(8, dims=-2)) - found.roll(4, dims=2)).abs().max() > 1e-2  # elevation is not a circle
