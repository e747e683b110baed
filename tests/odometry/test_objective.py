"""The loss of motions whose errors are known."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from lidarslam.odometry.network.networks import PairEstimate
from lidarslam.odometry.network.torch_geometry import skew
from lidarslam.odometry.training import losses as module
from lidarslam.odometry.training.config import TrainingConfig
from lidarslam.odometry.training.losses import Objective, objective
from lidarslam.odometry.training.pairs import PairBatch, pair_of, stack

TWIST = (0.0, 0.0, 0.8, 2.0, 0.6, 0.2)
WIDTH = 24
ALIGNMENT_ONLY = TrainingConfig(geometric=None)
PARTS = ("alignment", "confidence", "turn", "point_to_plane", "plane_to_plane")


def exp(xi: Tensor) -> Tensor:
    """SE(3) exponential (..., 4, 4) of tangents (..., 6), rotation first."""
    top = torch.cat([skew(xi[..., :3]), xi[..., 3:, None]], dim=-1)
    return torch.linalg.matrix_exp(torch.nn.functional.pad(top, (0, 0, 0, 1)))


@pytest.fixture(scope="module")
def pair(small_room) -> PairBatch:
    return pair_of(small_room.recording(2, TWIST), 0, 1)


def batch_of(targets: Tensor, valid: list[bool] | None = None) -> PairBatch:
    """Pairs without surfaces."""
    images = torch.zeros(len(targets), 6, 4, 8)
    return PairBatch(images, images, T_prev_curr=targets, valid=torch.tensor(valid or [True] * len(targets)))


def estimate_of(T: Tensor, log_sigma: float = 0.0, scores: Tensor | None = None) -> PairEstimate:
    scores = torch.zeros(len(T), WIDTH) if scores is None else scores
    return PairEstimate(T, torch.full((len(T), 6), log_sigma), scores, torch.zeros(len(T), 0, 0))


def loss(estimate: PairEstimate, batch: PairBatch, config: TrainingConfig = ALIGNMENT_ONLY) -> Objective:
    return objective(estimate, batch, config, torch.Generator().manual_seed(0))


def off(rotation_deg: float = 0.0, translation_m: float = 0.0) -> Tensor:
    """(1, 4, 4) changes from the left."""
    return exp(torch.tensor([[0.0, math.radians(rotation_deg), 0.0, 0.0, 0.0, translation_m]]))


def yaw(columns: float) -> Tensor:
    """(1, 4, 4) turns by so many columns of scores."""
    return exp(torch.tensor([[0.0, 0.0, columns * 2.0 * math.pi / WIDTH, 0.0, 0.0, 0.0]]))


def test_the_truth_costs_nothing_but_its_confidence():
    T = exp(torch.tensor([[0.1, -0.2, 0.3, 1.0, 2.0, 3.0]]))
    parts = loss(estimate_of(T, log_sigma=-5.0), batch_of(T))
    assert float(parts.alignment) == pytest.approx(0.0, abs=1e-6)
    assert float(parts.confidence) == pytest.approx(-30.0, abs=0.01)


@pytest.mark.parametrize(
    ("rotation_deg", "translation_m", "cost"),
    [(0.5, 0.0, 0.125), (1.0, 0.0, 0.5), (3.0, 0.0, 2.5), (0.0, 0.05, 0.5), (0.0, 0.25, 4.5)],
)
def test_errors_cost_their_square_and_then_their_size(rotation_deg, translation_m, cost):
    T = exp(torch.tensor([[0.1, -0.2, 0.3, 0.0, 0.0, 0.0]]))
    parts = loss(estimate_of(off(rotation_deg, translation_m) @ T), batch_of(T))
    assert float(parts.alignment) == pytest.approx(cost, rel=1e-3)


@pytest.mark.parametrize(
    ("config", "off_parts"),
    [
        (ALIGNMENT_ONLY, ("point_to_plane", "plane_to_plane")),
        (TrainingConfig(alignment_weight=0.0), ("alignment", "confidence", "turn")),
    ],
)
def test_parts_are_switched_off(pair, config, off_parts):
    parts = loss(estimate_of(off(2.0, 0.1) @ pair.T_prev_curr), pair, config)
    for name in PARTS:
        assert (float(getattr(parts, name)) == 0.0) == (name in off_parts)


def test_what_is_not_valid_does_not_count():
    targets = torch.eye(4).repeat(3, 1, 1)
    T = torch.cat([off(2.0), off(50.0, 9.0), off(0.0, 0.1)])
    scores = torch.randn(3, WIDTH, generator=torch.Generator().manual_seed(1))
    some = loss(estimate_of(T, scores=scores), batch_of(targets, [True, False, True]))
    without = loss(estimate_of(T[::2], scores=scores[::2]), batch_of(targets[::2]))
    for name in ("total", *PARTS):
        torch.testing.assert_close(getattr(some, name), getattr(without, name))


def test_nothing_valid_costs_nothing_and_pulls_nowhere():
    xi = torch.full((2, 6), 0.3, requires_grad=True)
    parts = loss(estimate_of(exp(xi)), batch_of(torch.eye(4).repeat(2, 1, 1), [False, False]))
    assert float(parts.total.detach()) == 0.0
    (gradient,) = torch.autograd.grad(parts.total, xi)
    assert not gradient.any()


def test_confidence_does_not_reach_the_motion():
    xi = torch.tensor([[0.01, 0.0, 0.02, 0.1, 0.0, -0.2]], requires_grad=True)
    log_sigma = torch.full((1, 6), -2.0, requires_grad=True)
    estimate = PairEstimate(exp(xi), log_sigma, torch.zeros(1, WIDTH), torch.zeros(1, 0, 0))
    parts = loss(estimate, batch_of(torch.eye(4)[None]))
    reached = torch.autograd.grad(parts.confidence, [xi, log_sigma], allow_unused=True)
    assert reached[0] is None
    assert reached[1] is not None


def test_confidence_is_best_at_the_standard_deviation_of_a_laplace_distribution():
    """Over many errors drawn from one the gradient vanishes at its standard deviation."""
    g = torch.Generator().manual_seed(0)
    uniform = torch.rand(50_000, generator=g, dtype=torch.float64) - 0.5
    sigma = 0.02
    errors = -uniform.sign() * torch.log1p(-2.0 * uniform.abs()) * (sigma / math.sqrt(2.0))
    xi = torch.zeros(len(errors), 6, dtype=torch.float64)
    xi[:, 4] = errors
    log_sigma = torch.tensor(math.log(sigma), dtype=torch.float64, requires_grad=True)
    none = torch.zeros(len(errors), 0)
    estimate = PairEstimate(exp(xi), log_sigma.expand(len(errors), 6), none, none[..., None])
    confidence = loss(estimate, batch_of(torch.eye(4, dtype=torch.float64).expand(len(errors), 4, 4))).confidence
    (gradient,) = torch.autograd.grad(confidence, log_sigma)
    # Five directions without an error pull by one each.
    assert float(gradient) == pytest.approx(5.0, abs=0.02)


@pytest.mark.parametrize(
    ("columns", "shares"),
    [
        (0.0, {0: 1.0}),
        (3.0, {3: 1.0}),
        (3.25, {3: 0.75, 4: 0.25}),
        (-0.25, {WIDTH - 1: 0.25, 0: 0.75}),
        (-5.0, {WIDTH - 5: 1.0}),
        (11.5, {11: 0.5, 12: 0.5}),
        (-11.5, {12: 0.5, 13: 0.5}),
    ],
)
def test_the_turn_is_shared_by_the_columns_around_it(columns, shares):
    scores = torch.zeros(1, WIDTH, requires_grad=True)
    parts = loss(estimate_of(torch.eye(4)[None], scores=scores), batch_of(yaw(columns)))
    assert float(parts.turn.detach()) == pytest.approx(math.log(WIDTH), rel=1e-5)
    (gradient,) = torch.autograd.grad(parts.turn, scores)
    expected = torch.zeros(WIDTH)
    for column, share in shares.items():
        expected[column] = share
    torch.testing.assert_close(1.0 / WIDTH - gradient[0], expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("x", "y", "shares"),
    [
        (0.0, 0.0, {(18, 18): 1.0}),
        (2.0, -1.0, {(17, 20): 1.0}),
        (0.25, 0.5, {(18, 18): 0.375, (18, 19): 0.125, (19, 18): 0.375, (19, 19): 0.125}),
    ],
)
def test_the_translation_is_shared_by_the_cells_around_it(x, y, shares):
    scores = torch.zeros(1, 37, 37, requires_grad=True)
    target = exp(torch.tensor([[0.0, 0.0, 0.0, x, y, 0.3]]))
    parts = loss(replace(estimate_of(torch.eye(4)[None]), shift_scores=scores), batch_of(target))
    assert float(parts.shift.detach()) == pytest.approx(2.0 * math.log(37), rel=1e-5)
    (gradient,) = torch.autograd.grad(parts.shift, scores)
    expected = torch.zeros(37, 37)
    for cell, share in shares.items():
        expected[cell] = share
    torch.testing.assert_close(37.0**-2 - gradient[0], expected, rtol=0, atol=1e-5)


def test_a_peak_that_is_not_the_right_one_is_not_drawn():
    """Only where there are scores, which are drawn instead."""
    far = exp(torch.tensor([[0.0, 0.0, 0.0, 3.0, 0.0, 0.0]]))
    parts = loss(estimate_of(far), batch_of(torch.eye(4)[None]))
    assert float(parts.alignment) == 0.0
    assert float(parts.confidence) > 1.0
    regressed = loss(estimate_of(far, scores=torch.zeros(1, 0)), batch_of(torch.eye(4)[None]))
    assert float(regressed.alignment) > 1.0


@pytest.mark.parametrize("change", [off(1.0), off(0.0, 0.05), off(-1.0), off(0.0, -0.05), yaw(0.1)])
def test_geometry_is_best_at_the_truth(pair, change):
    config = TrainingConfig(alignment_weight=0.0)
    truth = loss(estimate_of(pair.T_prev_curr), pair, config)
    beside = loss(estimate_of(change @ pair.T_prev_curr), pair, config)
    # The nearest point of some is that of another wall.
    assert truth.point_to_plane < 5e-4
    assert beside.point_to_plane > truth.point_to_plane + 2e-4


def test_geometry_compares_the_compensated_surfaces(pair):
    """Not what the network sees."""
    blind = replace(pair, previous=torch.zeros_like(pair.previous), current=torch.zeros_like(pair.current))
    config = TrainingConfig(alignment_weight=0.0)
    estimate = estimate_of(off(1.0) @ pair.T_prev_curr)
    assert torch.equal(loss(estimate, blind, config).total, loss(estimate, pair, config).total)


def test_geometry_looks_at_pairs_that_are_valid(pair, monkeypatch):
    """Where alignment failed, the compensation that surfaces rest on is a guess."""
    T = torch.cat([off(0.0, 0.03) @ pair.T_prev_curr, off(0.0, 0.2) @ pair.T_prev_curr])
    both = replace(stack([pair, pair]), valid=torch.tensor([True, False]))
    monkeypatch.setattr(module, "_GEOMETRIC_POINTS", 16 * 96)
    config = TrainingConfig(alignment_weight=0.0)
    some, one = loss(estimate_of(T), both, config), loss(estimate_of(T[:1]), pair, config)
    for name in ("total", "point_to_plane", "plane_to_plane"):
        torch.testing.assert_close(getattr(some, name), getattr(one, name))
    none = loss(estimate_of(T), replace(both, valid=torch.zeros(2, dtype=torch.bool)), config)
    assert float(none.total) == 0.0
