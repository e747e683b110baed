import numpy as np
import pytest
import torch

from lidarslam.odometry.training import losses as correspondence
from lidarslam.odometry.training.losses import nearest


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
