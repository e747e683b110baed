from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from lidarslam.odometry.network.torch_geometry import inverse, rotate, skew, transform_points
from lidarslam.odometry.training import losses as correspondence
from lidarslam.odometry.training.config import LossConfig
from lidarslam.odometry.training.losses import Surfaces, geometric_loss, nearest

EYE = torch.eye(4, dtype=torch.float64)[None]
XI = torch.tensor([0.03, -0.04, 0.05, 0.12, -0.1, 0.08], dtype=torch.float64)
PAPER = LossConfig(robust=False)


def exp(xi: Tensor) -> Tensor:
    """SE(3) exponential (..., 4, 4) of tangents (..., 6), rotation first."""
    top = torch.cat([skew(xi[..., :3]), xi[..., 3:, None]], dim=-1)
    return torch.linalg.matrix_exp(torch.nn.functional.pad(top, (0, 0, 0, 1)))


def _room(batch: int = 1, count: int = 600, seed: int = 0) -> Surfaces:
    """Points on the six sides of a box of 8 x 6 x 3 m around the origin, with normals inwards."""
    g = torch.Generator().manual_seed(seed)
    half = torch.tensor([4.0, 3.0, 1.5], dtype=torch.float64)
    points = (2.0 * torch.rand(batch, count, 3, generator=g, dtype=torch.float64) - 1.0) * half
    side = torch.arange(count) % 6
    axis, sign = (side % 3).expand(batch, -1)[..., None], torch.where(side < 3, 1.0, -1.0).double()
    points.scatter_(2, axis, (sign[:, None] * half[side % 3][:, None]).expand(batch, -1, 1))
    normals = torch.zeros_like(points).scatter_(2, axis, -sign[:, None].expand(batch, -1, 1))
    return Surfaces(points, normals, torch.ones(batch, count, dtype=torch.bool))


def _moved(surfaces: Surfaces, T: Tensor) -> Surfaces:
    return Surfaces(transform_points(T, surfaces.points), rotate(T, surfaces.normals), surfaces.valid)


def _select(surfaces: Surfaces, item: int) -> Surfaces:
    return Surfaces(*(getattr(surfaces, f.name)[item, None] for f in fields(Surfaces)))


def _floor(height: float) -> Surfaces:
    x, y = torch.meshgrid(torch.arange(10.0).double(), torch.arange(10.0).double(), indexing="ij")
    points = torch.stack([x.flatten(), y.flatten(), torch.full((100,), height, dtype=torch.float64)], dim=-1)[None]
    return Surfaces(
        points, torch.tensor([0.0, 0.0, 1.0]).double().expand(1, 100, 3), torch.ones(1, 100, dtype=torch.bool)
    )


CONFIGS = pytest.mark.parametrize(
    "config",
    [
        LossConfig(),
        PAPER,
        LossConfig(plane_to_plane=False),
        LossConfig(point_to_plane=False),
    ],
)


@CONFIGS
def test_zero_at_the_truth_and_growing_away_from_it(config: LossConfig) -> None:
    target, T_true = _room(), exp(XI)[None]
    source = _moved(target, inverse(T_true))
    at_truth = geometric_loss(T_true, source, target, config)
    assert at_truth.total.item() == pytest.approx(0.0, abs=1e-12)
    assert at_truth.matched_share.item() == 1.0
    axis = torch.tensor([0.5, -0.3, 0.8, 0.4, 0.2, -0.6], dtype=torch.float64)
    steps = (0.01, 0.03, 0.06, 0.1)
    losses = [geometric_loss(T_true @ exp(s * axis), source, target, config).total.item() for s in steps]
    assert losses[0] > 1e-6
    assert losses == sorted(losses)


@pytest.mark.parametrize("displacement", [0.02, -0.05, 0.3])
def test_displaced_plane(displacement: float) -> None:
    d, source, target = abs(displacement), _floor(displacement), _floor(0.0)
    squared = geometric_loss(EYE, source, target, PAPER)
    assert squared.point_to_plane.item() == pytest.approx(d**2, abs=1e-12)
    assert squared.plane_to_plane.item() == 0.0
    robust = geometric_loss(EYE, source, target, LossConfig()).point_to_plane.item()
    assert robust == pytest.approx(d**2 if d < 0.1 else 2 * 0.1 * d - 0.1**2, abs=1e-12)


@pytest.mark.parametrize("angle", [0.1, 1.0, 3.0])
def test_turned_normals(angle: float) -> None:
    target = _floor(0.0)
    turn = exp(torch.tensor([angle, 0, 0, 0, 0, 0]).double())[None]
    source = replace(target, normals=rotate(turn, target.normals))
    assert geometric_loss(EYE, source, target, PAPER).total.item() == pytest.approx(2 - 2 * np.cos(angle), abs=1e-7)


def test_paper_settings_are_the_papers_formulas() -> None:
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
    assert loss.point_to_plane.item() == pytest.approx(p2n, rel=1e-12)
    assert loss.plane_to_plane.item() == pytest.approx(n2n, rel=1e-12)
    assert loss.total.item() == pytest.approx(1.0 * p2n + n2n, rel=1e-12)
    assert loss.matched_share.item() == pytest.approx(len(pairs) / has_s.sum())


def test_pixels_without_a_point_are_never_candidates() -> None:
    source, target = _floor(1.0), _floor(1.0)
    source.points[0, 0] = 0.01
    target.points[0, 0], target.valid[0, 0] = 0.0, False
    assert geometric_loss(EYE, source, target, PAPER).matched_share.item() == 1.0


def test_source_points_without_a_normal_are_left_out() -> None:
    source, target = _floor(0.05), _floor(0.0)
    source.points[0, :30, 2] = 0.9  # within the gate
    source.valid[0, :30] = False
    loss = geometric_loss(EYE, source, target, PAPER)
    assert loss.point_to_plane.item() == pytest.approx(0.05**2, abs=1e-12)
    assert loss.matched_share.item() == 1.0


@pytest.mark.parametrize("config", [PAPER, LossConfig()])
def test_gradient_agrees_with_finite_differences(config: LossConfig) -> None:
    """While the correspondences stay, the loss is smooth, and its gradient that of the moved points and normals."""
    target = _room(count=60)
    source = _moved(target, inverse(exp(XI)[None]))
    xi = (0.9 * XI)[None].requires_grad_()
    assert torch.autograd.gradcheck(lambda x: geometric_loss(exp(x), source, target, config).total, (xi,), atol=1e-6)


@CONFIGS
def test_items_of_a_batch_do_not_see_each_other(config: LossConfig) -> None:
    target = _room(batch=3)
    target.valid[1, ::2] = False
    T_true = exp(torch.stack([XI, -XI, 2 * XI]))
    source = _moved(target, inverse(T_true))
    source.valid[2, ::3] = False
    T = exp(torch.stack([0.5 * XI, 0.0 * XI, 1.5 * XI]))
    together = geometric_loss(T, source, target, config)
    for item in range(3):
        alone = geometric_loss(T[item, None], _select(source, item), _select(target, item), config)
        for name in ("total", "point_to_plane", "plane_to_plane", "matched_share"):
            torch.testing.assert_close(getattr(together, name)[item, None], getattr(alone, name))
    assert len(set(together.total.tolist())) == 3


@pytest.fixture(params=["k-d tree", "all distances"])
def search(request, monkeypatch):
    """The search of the CPU, and that of other devices."""
    if request.param == "all distances":
        monkeypatch.setattr(correspondence, "_by_kd_tree", correspondence._by_all_distances)
    return nearest


def _clouds(offset: float = 0.0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(5)
    query, reference = (offset + 10.0 * torch.rand(3, n, 3, generator=g) for n in (70, 90))
    return query, reference, torch.rand(3, 90, generator=g) < 0.5


@pytest.mark.parametrize("offset", [0.0, 100.0])
def test_finds_the_nearest_of_the_valid(search, offset: float) -> None:
    query, reference, valid = _clouds(offset)
    index, distance = search(query, reference, valid)
    q, r = query.double().numpy(), reference.double().numpy()
    all_distances = np.linalg.norm(q[:, :, None] - r[:, None], axis=-1)
    all_distances[np.broadcast_to(~valid.numpy()[:, None], all_distances.shape)] = np.inf
    assert index.dtype == torch.int64
    np.testing.assert_array_equal(index.numpy(), all_distances.argmin(-1))
    np.testing.assert_allclose(distance.numpy(), all_distances.min(-1), rtol=1e-6)


@pytest.mark.parametrize("max_distances", [1, 90, 200, 10**6])
def test_all_distances_and_tree_agree_however_they_are_split(max_distances: int, monkeypatch) -> None:
    clouds = _clouds(50.0)
    tree_index, tree_distance = nearest(*clouds)
    monkeypatch.setattr(correspondence, "_MAX_DISTANCES", max_distances)
    monkeypatch.setattr(correspondence, "_by_kd_tree", correspondence._by_all_distances)
    index, distance = nearest(*clouds)
    assert torch.equal(index, tree_index)
    torch.testing.assert_close(distance, tree_distance, rtol=1e-6, atol=0)


def test_what_is_not_finite_is_not_found(search) -> None:
    query, reference, valid = _clouds()
    expected = search(query, reference, valid)
    query[0, 3], query[1, 4] = torch.nan, torch.inf
    index, distance = search(query, reference, valid)
    for item, point in ((0, 3), (1, 4)):
        assert index[item, point] == 0
        assert distance[item, point].isinf()
        expected[0][item, point], expected[1][item, point] = 0, torch.inf
    assert torch.equal(index, expected[0])
    assert torch.equal(distance, expected[1])
