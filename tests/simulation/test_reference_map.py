"""The reference map holds what was seen, evenly, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import KDTree

from lidarslam.simulation.mesh import Mesh, box_mesh, pieces_near
from lidarslam.simulation.reference_map import SeenSurfaces, reference_map, sample_seen
from lidarslam.simulation.world import Boxes

from .conftest import in_world, simulation_in

# A square of 10 m split into two triangles, facing up.
SQUARE = Mesh(np.array([[0.0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0]]), np.int32([[0, 1, 2], [0, 2, 3]]))


def grid(x, y, z):
    return np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3).astype(float)


@pytest.fixture(scope="module")
def recording(yard):
    return simulation_in(yard, "tracked", 0.6, 400)


@pytest.fixture(scope="module")
def yard_map(recording):
    return reference_map(recording, spacing_m=0.15, step=40)


def see(x, y, z, normal=(0.0, 0.0, 1.0), from_behind=False):
    """Surfaces seen at the nodes of a grid, and the nodes."""
    seen, points = SeenSurfaces(), grid(x, y, z)
    seen.add(points, np.tile(normal, (len(points), 1)), np.full(len(points), from_behind))
    return seen, points


ALL = np.arange(0.05, 10.0, 0.1)


def test_samples_are_even():
    seen, points = see(ALL, ALL, [0.0])
    sampled = sample_seen(SQUARE, seen, spacing_m=0.1).points
    assert abs(len(sampled) - 10_000) < 10
    np.testing.assert_array_equal(sampled[:, 2], 0.0)
    gaps, _ = KDTree(sampled).query(points)
    assert gaps.max() < 0.15
    alone, _ = KDTree(sampled).query(sampled, k=2)
    assert np.quantile(alone[:, 1], 0.05) > 0.03


def test_only_what_was_seen_is_kept():
    seen, _ = see(np.arange(0.05, 5.0, 0.1), ALL, [0.0])
    sampled = sample_seen(SQUARE, seen, spacing_m=0.1).points
    assert 5.0 < sampled[:, 0].max() < 5.4
    assert len(sample_seen(SQUARE, SeenSurfaces(), 0.1).points) == 0


def test_the_far_side_of_a_wall_stays_out_and_normals_are_of_the_side_that_was_seen():
    wall = box_mesh(Boxes(np.array([[0.0, 0.0, 1.0]]), np.array([[0.05, 4.0, 1.0]]), np.eye(3)[None]))
    seen, _ = see([0.05], np.arange(-4.0, 4.0, 0.1), np.arange(0.0, 2.0, 0.1), normal=(1.0, 0.0, 0.0))
    sampled, normals = sample_seen(wall, seen, spacing_m=0.05)
    np.testing.assert_allclose(sampled[:, 0], 0.05, atol=1e-12)
    np.testing.assert_allclose(normals, np.tile([1.0, 0.0, 0.0], (len(normals), 1)), atol=1e-12)
    seen, _ = see(ALL, ALL, [0.0], from_behind=True)  # a ceiling
    normals = sample_seen(SQUARE, seen, spacing_m=0.2).normals
    np.testing.assert_allclose(normals, np.tile([0.0, 0.0, -1.0], (len(normals), 1)), atol=1e-12)


def test_the_map_covers_the_scans_and_movers_are_not_in_it(recording, yard_map):
    sweep = recording.scan(80)
    still = ~sweep.moving & np.isfinite(sweep.true_ranges)
    gaps, _ = KDTree(yard_map.points).query(in_world(recording, sweep.scan)[still])
    assert np.quantile(gaps, 0.98) < 0.25
    inside = np.linalg.norm(yard_map.points[:, :2], axis=1).min()
    assert inside > 2.5  # the middle block's inside is not seen
    still = replace(recording, world=replace(recording.world, movers=()))
    without = reference_map(still, spacing_m=0.15, step=40)
    gaps, _ = KDTree(without.points).query(yard_map.points)
    assert gaps.max() < 1e-9


def test_cutting_keeps_area_orientation_and_all_that_is_near():
    voxels = np.array([[0, 0, 0], [12, 3, 0]])
    pieces = pieces_near(SQUARE, voxels, voxel_m=0.2)
    area = pieces.ends - pieces.starts
    a, b, c = np.moveaxis(pieces.corners, 1, 0)
    np.testing.assert_allclose(0.5 * np.cross(b - a, c - a)[:, 2], area, atol=1e-12)
    low, high = pieces.bounds
    assert (high - low).max() <= 1.6
    assert area.sum() < 30.0
    assert high[:, 0].max() > 2.6
    assert len(pieces_near(SQUARE, np.array([[0, 0, 50]]), 0.2).corners) == 0
