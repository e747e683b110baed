"""The losses of motions whose errors are known."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from lidarslam.odometry.config import LossConfig, TrainingConfig
from lidarslam.odometry.network.networks import PairEstimate
from lidarslam.odometry.network.torch_geometry import inverse, rotate, transform_points
from lidarslam.odometry.training import losses as module
from lidarslam.odometry.training.losses import Objective, Surfaces, geometric_loss, nearest, objective
from lidarslam.odometry.training.pairs import PairBatch, pair_of, stack

from .motions import torch_exp as exp

EYE = torch.eye(4, dtype=torch.float64)[None]
XI = torch.tensor([0.03, -0.04, 0.05, 0.12, -0.1, 0.08], dtype=torch.float64)
PAPER, ROBUST = LossConfig(robust=False), LossConfig()


def room(batch: int = 1, count: int = 600) -> Surfaces:
    """Points on the six sides of a box of 8 x 6 x 3 m around the origin, with normals inwards."""
    half = torch.tensor([4.0, 3.0, 1.5], dtype=torch.float64)
    drawn = torch.rand(batch, count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points = (2.0 * drawn - 1.0) * half
    side = torch.arange(count) % 6
    axis, sign = (side % 3).expand(batch, -1)[..., None], torch.where(side < 3, 1.0, -1.0).double()
    points.scatter_(2, axis, (sign[:, None] * half[side % 3][:, None]).expand(batch, -1, 1))
    normals = torch.zeros_like(points).scatter_(2, axis, -sign[:, None].expand(batch, -1, 1))
    return Surfaces(points, normals, torch.ones(batch, count, dtype=torch.bool))


def moved(surfaces: Surfaces, T: Tensor) -> Surfaces:
    return Surfaces(transform_points(T, surfaces.points), rotate(T, surfaces.normals), surfaces.valid)


def floor(height: float) -> Surfaces:
    x, y = torch.meshgrid(torch.arange(10.0).double(), torch.arange(10.0).double(), indexing="ij")
    points = torch.stack([x.flatten(), y.flatten(), torch.full((100,), height, dtype=torch.float64)], dim=-1)[None]
    normals = torch.tensor([0.0, 0.0, 1.0]).double().expand(1, 100, 3)
    return Surfaces(points, normals, torch.ones(1, 100, dtype=torch.bool))


CONFIGS = pytest.mark.parametrize(
    "config", [ROBUST, PAPER, LossConfig(plane_to_plane=False), LossConfig(point_to_plane=False)]
)


@CONFIGS
def test_zero_at_the_truth_and_growing_away_from_it(config):
    target, T_true = room(), exp(XI)[None]
    source = moved(target, inverse(T_true))
    axis = torch.tensor([0.5, -0.3, 0.8, 0.4, 0.2, -0.6], dtype=torch.float64)
    steps = (0.0, 0.01, 0.03, 0.06, 0.1)
    losses = [geometric_loss(T_true @ exp(s * axis), source, target, config).total.item() for s in steps]
    assert losses[0] == pytest.approx(0.0, abs=1e-12)
    assert losses[1] > 1e-6
    assert losses == sorted(losses)


@pytest.mark.parametrize("displacement", [0.02, -0.05, 0.3])
def test_the_robust_loss_of_a_displaced_plane_grows_with_its_square_and_then_its_size(displacement):
    d = abs(displacement)
    robust = geometric_loss(EYE, floor(displacement), floor(0.0), ROBUST)
    assert robust.point_to_plane.item() == pytest.approx(d**2 if d < 0.1 else 2 * 0.1 * d - 0.1**2, abs=1e-12)
    assert robust.plane_to_plane.item() == 0.0


def test_paper_settings_are_the_papers_formulas():
    rng = np.random.default_rng(9)
    S, M = rng.normal(size=(80, 3)) * 5, rng.normal(size=(100, 3)) * 5
    N_s, N_m = (rng.normal(size=(count, 3)) for count in (80, 100))
    N_s, N_m = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (N_s, N_m))
    has_s, has_m = rng.random(80) < 0.7, rng.random(100) < 0.6
    T = exp(XI).numpy()
    # The paper, line by line: move, look for the nearest of all points, omit pairs in which a normal is missing.
    s_hat, n_hat = S @ T[:3, :3].T + T[:3, 3], N_s @ T[:3, :3].T
    _, found = cKDTree(M).query(s_hat)
    pairs = [(i, j) for i, j in enumerate(found) if has_s[i] and has_m[j]]
    p2n = sum(np.dot(s_hat[i] - M[j], N_m[j]) ** 2 for i, j in pairs) / len(pairs)
    n2n = sum(np.sum((n_hat[i] - N_m[j]) ** 2) for i, j in pairs) / len(pairs)

    source, target = (Surfaces(*(torch.tensor(x)[None] for x in cloud)) for cloud in ((S, N_s, has_s), (M, N_m, has_m)))
    loss = geometric_loss(exp(XI)[None], source, target, PAPER)
    assert [one.item() for one in loss] == pytest.approx([p2n + n2n, p2n, n2n], rel=1e-12)


def test_points_without_a_normal_and_pixels_without_a_point_are_left_out():
    source, target = floor(1.05), floor(1.0)
    source.points[0, :30, 2], source.valid[0, :30] = 1.9, False  # within the gate
    source.points[0, 40] = 0.01
    target.points[0, 0], target.valid[0, 0] = 0.0, False
    assert geometric_loss(EYE, source, target, ROBUST).point_to_plane.item() == pytest.approx(0.05**2, abs=1e-12)


@pytest.mark.parametrize("config", [PAPER, ROBUST])
def test_gradient_agrees_with_finite_differences(config):
    """While the correspondences stay, the loss is smooth, and its gradient that of the moved points and normals."""
    target = room(count=60)
    source = moved(target, inverse(exp(XI)[None]))
    xi = (0.9 * XI)[None].requires_grad_()
    assert torch.autograd.gradcheck(lambda x: geometric_loss(exp(x), source, target, config).total, (xi,), atol=1e-6)


@CONFIGS
def test_items_of_a_batch_do_not_see_each_other(config):
    target = room(batch=3)
    target.valid[1, ::2] = False
    source = moved(target, inverse(exp(torch.stack([XI, -XI, 2 * XI]))))
    source.valid[2, ::3] = False
    T = exp(torch.stack([0.5 * XI, 0.0 * XI, 1.5 * XI]))
    together = geometric_loss(T, source, target, config)
    for item in range(3):
        one, other = (Surfaces(*(part[item, None] for part in cloud)) for cloud in (source, target))
        alone = geometric_loss(T[item, None], one, other, config)
        torch.testing.assert_close([part[item, None] for part in together], list(alone))
    assert len(set(together.total.tolist())) == 3


@pytest.mark.parametrize("max_distances", [None, 1, 90, 10**6])
@pytest.mark.parametrize("offset", [0.0, 100.0])
def test_the_nearest_of_the_valid_is_found(max_distances, offset, monkeypatch):
    """By a k-d tree, and as on other devices by all distances, however these are split; what is not finite, never."""
    if max_distances is not None:
        monkeypatch.setattr(module, "_MAX_DISTANCES", max_distances)
        monkeypatch.setattr(module, "_by_kd_tree", module._by_all_distances)
    g = torch.Generator().manual_seed(5)
    query, reference = (offset + 10.0 * torch.rand(3, n, 3, generator=g) for n in (70, 90))
    valid = torch.rand(3, 90, generator=g) < 0.5
    q, r = query.double().numpy(), reference.double().numpy()
    expected = np.linalg.norm(q[:, :, None] - r[:, None], axis=-1)
    expected[np.broadcast_to(~valid.numpy()[:, None], expected.shape)] = np.inf
    query[0, 3], query[1, 4] = torch.nan, torch.inf
    expected[0, 3], expected[1, 4] = np.inf, np.inf
    index, distance = nearest(query, reference, valid)
    np.testing.assert_array_equal(index.numpy(), expected.argmin(-1))
    np.testing.assert_allclose(distance.numpy(), expected.min(-1), rtol=1e-6)


TWIST = (0.0, 0.0, 0.8, 2.0, 0.6, 0.2)
WIDTH = 24
ALIGNMENT_ONLY, GEOMETRY_ONLY = TrainingConfig(geometric=None), TrainingConfig(alignment_weight=0.0)
PARTS = ("alignment", "confidence", "turn", "point_to_plane", "plane_to_plane")


@pytest.fixture(scope="module")
def pair(small_room) -> PairBatch:
    return pair_of(small_room.recording(2, TWIST), 0, 1)


def batch_of(targets: Tensor, valid: list[bool] | None = None) -> PairBatch:
    images = torch.zeros(len(targets), 2, 6, 4, 8)
    return PairBatch(images, T_prev_curr=targets, valid=torch.tensor(valid or [True] * len(targets)))


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


@pytest.mark.parametrize(
    ("rotation_deg", "translation_m", "cost"),
    [(0.0, 0.0, 0.0), (0.5, 0.0, 0.125), (1.0, 0.0, 0.5), (3.0, 0.0, 2.5), (0.0, 0.05, 0.5), (0.0, 0.25, 4.5)],
)
def test_errors_cost_their_square_and_then_their_size(rotation_deg, translation_m, cost):
    T = exp(torch.tensor([[0.1, -0.2, 0.3, 0.0, 0.0, 0.0]]))
    parts = loss(estimate_of(off(rotation_deg, translation_m) @ T, log_sigma=5.0), batch_of(T))
    assert float(parts.alignment) == pytest.approx(cost, rel=1e-3, abs=1e-6)
    assert float(parts.confidence) == pytest.approx(30.0, abs=0.01)


@pytest.mark.parametrize(
    ("config", "off_parts"),
    [(ALIGNMENT_ONLY, {"point_to_plane", "plane_to_plane"}), (GEOMETRY_ONLY, {"alignment", "confidence", "turn"})],
)
def test_parts_are_switched_off(pair, config, off_parts):
    parts = loss(estimate_of(off(2.0, 0.1) @ pair.T_prev_curr), pair, config)
    assert {name for name in PARTS if float(getattr(parts, name)) == 0.0} == off_parts


def test_what_is_not_valid_does_not_count():
    targets = torch.eye(4).repeat(3, 1, 1)
    T = torch.cat([off(2.0), off(50.0, 9.0), off(0.0, 0.1)])
    scores = torch.randn(3, WIDTH, generator=torch.Generator().manual_seed(1))
    some = loss(estimate_of(T, scores=scores), batch_of(targets, [True, False, True]))
    without = loss(estimate_of(T[::2], scores=scores[::2]), batch_of(targets[::2]))
    torch.testing.assert_close(list(some), list(without))
    xi = torch.full((2, 6), 0.3, requires_grad=True)
    nothing = loss(estimate_of(exp(xi)), batch_of(targets[:2], [False, False])).total
    assert float(nothing.detach()) == 0.0
    assert not torch.autograd.grad(nothing, xi)[0].any()


def test_confidence_does_not_reach_the_motion():
    xi = torch.tensor([[0.01, 0.0, 0.02, 0.1, 0.0, -0.2]], requires_grad=True)
    log_sigma = torch.full((1, 6), -2.0, requires_grad=True)
    parts = loss(replace(estimate_of(exp(xi)), log_sigma=log_sigma), batch_of(torch.eye(4)[None]))
    reached = torch.autograd.grad(parts.confidence, [xi, log_sigma], allow_unused=True)
    assert [one is not None for one in reached] == [False, True]


def test_confidence_is_best_at_the_standard_deviation_of_a_laplace_distribution():
    """Over many errors drawn from one the gradient vanishes at its standard deviation."""
    g = torch.Generator().manual_seed(0)
    uniform = torch.rand(50_000, generator=g, dtype=torch.float64) - 0.5
    sigma = 0.02
    xi = torch.zeros(len(uniform), 6, dtype=torch.float64)
    xi[:, 4] = -uniform.sign() * torch.log1p(-2.0 * uniform.abs()) * (sigma / math.sqrt(2.0))
    log_sigma = torch.tensor(math.log(sigma), dtype=torch.float64, requires_grad=True)
    estimate = replace(estimate_of(exp(xi)), log_sigma=log_sigma.expand(len(xi), 6))
    confidence = loss(estimate, batch_of(torch.eye(4, dtype=torch.float64).expand(len(xi), 4, 4))).confidence
    (gradient,) = torch.autograd.grad(confidence, log_sigma)
    # Five directions without an error pull by one each.
    assert float(gradient) == pytest.approx(5.0, abs=0.02)


@pytest.mark.parametrize(("part", "size", "target", "shares"), [
    ("turn", (WIDTH,), yaw(3.0), {3: 1.0}), ("turn", (WIDTH,), yaw(3.25), {3: 0.75, 4: 0.25}),
    ("turn", (WIDTH,), yaw(-0.25), {WIDTH - 1: 0.25, 0: 0.75}), ("turn", (WIDTH,), yaw(-11.5), {12: 0.5, 13: 0.5}),
    ("shift", (37, 37), exp(torch.tensor([[0.0, 0.0, 0.0, 2.0, -1.0, 0.3]])), {(17, 20): 1.0}),
    ("shift", (37, 37), exp(torch.tensor([[0.0, 0.0, 0.0, 0.25, 0.5, 0.3]])),
     {(18, 18): 0.375, (18, 19): 0.125, (19, 18): 0.375, (19, 19): 0.125}),
])  # fmt: skip
def test_turn_and_translation_are_shared_by_the_columns_and_cells_around_them(part, size, target, shares):
    """The loss of even scores, whose gradient pulls at those of the target."""
    scores = torch.zeros(1, *size, requires_grad=True)
    estimate = replace(estimate_of(torch.eye(4)[None]), **{f"{part}_scores": scores})
    found = getattr(loss(estimate, batch_of(target)), part)
    assert float(found.detach()) == pytest.approx(math.log(scores.numel()), rel=1e-5)
    (gradient,) = torch.autograd.grad(found, scores)
    expected = torch.zeros(size)
    for index, share in shares.items():
        expected[index] = share
    torch.testing.assert_close(1.0 / scores.numel() - gradient[0], expected, rtol=0, atol=1e-5)


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
    truth = loss(estimate_of(pair.T_prev_curr), pair, GEOMETRY_ONLY)
    beside = loss(estimate_of(change @ pair.T_prev_curr), pair, GEOMETRY_ONLY)
    # The nearest point of some is that of another wall.
    assert truth.point_to_plane < 5e-4
    assert beside.point_to_plane > truth.point_to_plane + 2e-4
    # Surfaces are compared, not what the network sees.
    blind = replace(pair, scans=torch.zeros_like(pair.scans))
    assert torch.equal(loss(estimate_of(change @ pair.T_prev_curr), blind, GEOMETRY_ONLY).total, beside.total)


def test_geometry_looks_at_pairs_that_are_valid(pair, monkeypatch):
    """Where alignment failed, the compensation that surfaces rest on is a guess."""
    T = torch.cat([off(0.0, 0.03) @ pair.T_prev_curr, off(0.0, 0.2) @ pair.T_prev_curr])
    both = replace(stack([pair, pair]), valid=torch.tensor([True, False]))
    monkeypatch.setattr(module, "_GEOMETRIC_POINTS", 16 * 96)
    some, one = loss(estimate_of(T), both, GEOMETRY_ONLY), loss(estimate_of(T[:1]), pair, GEOMETRY_ONLY)
    torch.testing.assert_close(list(some), list(one))
