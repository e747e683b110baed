import math

import numpy as np
import pytest
import torch

from odometry.images.projection import ImageGrid, project
from odometry.training.correspondence import by_projection, nearest, nearest_brute_force, nearest_kd_tree

SEARCHES = pytest.mark.parametrize("search", [nearest, nearest_kd_tree, nearest_brute_force])


def _clouds(offset: float = 0.0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(5)
    query, reference = (offset + 10.0 * torch.rand(3, n, 3, generator=g) for n in (70, 90))
    return query, reference, torch.rand(3, 90, generator=g) < 0.5


@SEARCHES
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
def test_brute_force_and_tree_agree_however_it_is_split(max_distances: int) -> None:
    clouds = _clouds(50.0)
    index, distance = nearest_brute_force(*clouds, max_distances=max_distances)
    tree_index, tree_distance = nearest_kd_tree(*clouds, workers=2)
    assert torch.equal(index, tree_index)
    torch.testing.assert_close(distance, tree_distance, rtol=1e-6, atol=0)


@SEARCHES
def test_items_without_reference(search) -> None:
    query, reference, valid = _clouds()
    valid[1] = False
    index, distance = search(query, reference, valid)
    assert (index[1] == 0).all()
    assert distance[1].isinf().all()
    alone = search(query[2:], reference[2:], valid[2:])
    assert torch.equal(index[2], alone[0][0])
    assert torch.equal(distance[2], alone[1][0])


@SEARCHES
def test_what_is_not_finite_is_not_found(search) -> None:
    query, reference, valid = _clouds()
    expected = search(query, reference, valid & (torch.arange(90) > 0))
    reference[:, 0], valid[:, 0] = torch.nan, True
    query[0, 3], query[1, 4] = torch.nan, torch.inf
    index, distance = search(query, reference, valid)
    for item, point in ((0, 3), (1, 4)):
        assert index[item, point] == 0
        assert distance[item, point].isinf()
        expected[0][item, point], expected[1][item, point] = 0, torch.inf
    assert torch.equal(index, expected[0])
    assert torch.equal(distance, expected[1])


@SEARCHES
@pytest.mark.parametrize(("queries", "references"), [(0, 5), (5, 0)])
def test_empty_clouds(search, queries: int, references: int) -> None:
    index, distance = search(torch.ones(2, queries, 3), torch.ones(2, references, 3), torch.ones(2, references).bool())
    assert index.shape == distance.shape == (2, queries)
    assert distance.isinf().all()


@SEARCHES
def test_no_gradient_through_the_search(search) -> None:
    query, reference, valid = _clouds()
    _, distance = search(query.requires_grad_(), reference, valid)
    assert not distance.requires_grad


def _image() -> tuple[ImageGrid, torch.Tensor]:
    """Two images 4 x 8 of points 2 m and 3 m away, the pixel (1, 2) empty."""
    grid = ImageGrid(4, 8, -0.3, 0.3)
    elevation = torch.linspace(-0.3, 0.3, 4)[:, None]
    azimuth = ((torch.arange(8) + 0.5) * (2.0 * math.pi / 8))[None]
    x, y = elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin()
    directions = torch.stack([x, y, elevation.sin().expand(4, 8)])
    sphere = torch.cat([directions, torch.ones(1, 4, 8)])
    images = torch.stack([2.0 * sphere, 3.0 * sphere])
    images[:, :, 1, 2] = 0.0
    return grid, images


def test_projection_finds_each_pixel_from_its_own_direction() -> None:
    grid, images = _image()
    query = 1.7 * images[:, :3].flatten(2).transpose(1, 2)
    index, distance = by_projection(query, images, grid)
    occupied = images[0, 3].flatten() > 0
    assert torch.equal(index[:, occupied], torch.arange(32)[occupied].expand(2, -1))
    torch.testing.assert_close(distance[0, occupied], torch.full((31,), 0.7 * 2.0))
    torch.testing.assert_close(distance[1, occupied], torch.full((31,), 0.7 * 3.0))


def test_projection_outside_and_onto_nothing() -> None:
    grid, images = _image()
    empty = torch.tensor([-0.09 * 4.0 * 0.38, 0.92 * 4.0, -0.1 * 4.0])  # towards pixel (1, 2), which is empty
    row, column = grid.place(empty.numpy())
    assert (np.floor(row + 0.5), np.floor(column)) == (1, 2)
    query = torch.stack([empty, torch.tensor([0.1, 0.0, 5.0]), torch.tensor([torch.nan, 0.0, 0.0])])
    index, distance = by_projection(query.expand(2, 3, 3), images, grid)
    assert distance.isinf().all()
    assert (index[:, 1:] == 0).all()


def test_projection_agrees_with_the_projection_of_scans() -> None:
    g = torch.Generator().manual_seed(2)
    points = torch.randn(200, 3, generator=g) * torch.tensor([5.0, 5.0, 1.0])
    grid = ImageGrid(8, 32, -0.4, 0.4)
    projection = project(points.numpy(), grid)
    shown = torch.from_numpy(projection.index).flatten()
    index, distance = by_projection(points[None, shown[shown >= 0]], torch.from_numpy(projection.image)[None], grid)
    assert torch.equal(index[0], torch.nonzero(shown >= 0)[:, 0])
    assert (distance == 0).all()


def test_projection_needs_the_grid_of_the_image() -> None:
    _, images = _image()
    with pytest.raises(ValueError, match=r"4 x 8.*4 x 16"):
        by_projection(torch.ones(2, 1, 3), images, ImageGrid(4, 16, -0.3, 0.3))
