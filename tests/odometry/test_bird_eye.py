"""Scans seen from above."""

import math

import numpy as np
import pytest
import torch

from lidarslam.odometry.images.bird_eye import CELL_M, CELLS, CHANNELS, bird_eye
from lidarslam.odometry.training.pairs import birds

MIDDLE = CELLS // 2


def image(points: list[tuple[float, float, float]], normals: list[tuple[float, float, float]] | None = None):
    """Points and normals (3, 1, W) of a single row."""
    given = np.array(points, dtype=np.float32).T[:, None]
    facing = np.zeros_like(given) if normals is None else np.array(normals, dtype=np.float32).T[:, None]
    return given, facing


@pytest.mark.parametrize(("x", "y"), [(0.1, 0.1), (7.3, -4.9), (-19.9, 0.1), (0.2, 19.9), (-CELL_M / 2, -CELL_M / 2)])
def test_a_point_lies_in_its_cell(x, y):
    grid = bird_eye(*image([(x, y, 0.0)]), 0.0)
    assert grid.shape == (CHANNELS, CELLS, CELLS)
    rows, columns = np.nonzero(grid[0])
    assert (rows.tolist(), columns.tolist()) == (
        [math.floor(y / CELL_M) + MIDDLE], [math.floor(x / CELL_M) + MIDDLE]
    )  # fmt: skip


@pytest.mark.parametrize("heading", [0.3, math.pi / 2, -2.0])
def test_the_heading_turns_points_and_normals(heading):
    c, s = math.cos(heading), math.sin(heading)
    x, y, u, v = 6.2, -3.3, 0.6, 0.8
    level = image([(x, y, 0.7)], [(u, v, 0.0)])
    turned = image([(c * x - s * y, s * x + c * y, 0.7)], [(c * u - s * v, s * u + c * v, 0.0)])
    np.testing.assert_allclose(bird_eye(*level, heading), bird_eye(*turned, 0.0), atol=1e-5)


def test_walls_differ_from_ground_and_are_the_same_from_both_sides():
    def cell(normal: tuple[float, float, float]):
        return bird_eye(*image([(5.1, 5.1, 0.0)], [normal]), 0.0)[:, MIDDLE + 5, MIDDLE + 5]

    ground, wall, behind, across = (cell(n) for n in ((0, 0, 1), (1, 0, 0), (-1, 0, 0), (0, 1, 0)))
    assert ground[2] == 0.0
    np.testing.assert_allclose(wall, behind)
    assert wall[2] > 0.5
    np.testing.assert_allclose(wall[3], -across[3])
    assert wall[3] > 0.5


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_grids_of_a_batch_are_those_of_each_scan(rng, scale):
    points = rng.normal(scale=15.0, size=(3, 3, 16, 90)).astype(np.float32)
    normals = rng.normal(size=points.shape).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points[..., ::5], normals[..., ::3] = 0.0, 0.0
    headings = (0.0, 1.1, -2.7)
    images = torch.from_numpy(np.concatenate([points, normals], axis=1))[:, None]
    grids = birds(images, torch.tensor(headings)[:, None], torch.full((3, 1), scale)).numpy()[:, 0]
    for one, (cloud, directions, heading) in zip(grids, zip(points, normals, headings, strict=True), strict=True):
        alone = bird_eye(cloud * np.float32([[[scale]], [[scale]], [[1.0]]]), directions, heading)
        np.testing.assert_allclose(one[[0, 2, 3, 4, 5, 6, 7]], alone[[0, 2, 3, 4, 5, 6, 7]], atol=1e-5)
        if scale == 1.0:
            np.testing.assert_allclose(one[1], alone[1], atol=1e-5)  # the density is that of the scene as it is
