"""Triangles of the primitives: closed, outward, of the right size, and where the formulas say."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidarslam.simulation.mesh import (
    CYLINDER_SIDES,
    Mesh,
    box_mesh,
    cylinder_mesh,
    height_field_mesh,
    world_mesh,
)
from lidarslam.simulation.world import Boxes, Cylinders, HeightField, Route, World


@pytest.fixture
def boxes(rng: np.random.Generator) -> Boxes:
    turns = Rotation.from_quat(rng.standard_normal((7, 4))).as_matrix()
    return Boxes(rng.normal(0.0, 20.0, (7, 3)), rng.uniform(0.1, 3.0, (7, 3)), turns)


@pytest.fixture
def cylinders(rng: np.random.Generator) -> Cylinders:
    """Three along the axes, where "any direction across" is easily a wrong one, and some askew."""
    starts = rng.normal(0.0, 20.0, (8, 3))
    axes = np.concatenate([np.diag([2.0, -3.0, 0.5]), rng.normal(0.0, 2.0, (5, 3))])
    return Cylinders(starts, starts + axes, rng.uniform(0.05, 2.0, 8))


@pytest.fixture
def field(rng: np.random.Generator) -> HeightField:
    return HeightField(np.array([-3.0, 5.0]), 0.7, rng.normal(0.0, 1.0, (6, 9)))


def normals_of(mesh: Mesh) -> np.ndarray:
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    return np.cross(b - a, c - a)


def areas(mesh: Mesh) -> np.ndarray:
    return 0.5 * np.linalg.norm(normals_of(mesh), axis=1)


def volumes(mesh: Mesh, per_solid: int) -> np.ndarray:
    """Signed volume of each solid, positive when its triangles face outwards (divergence theorem)."""
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    return (np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0).reshape(-1, per_solid).sum(axis=1)


def assert_closed(mesh: Mesh) -> None:
    """Each directed edge occurs once and once in reverse: watertight, and oriented all one way."""
    edges = np.concatenate([mesh.triangles[:, [0, 1]], mesh.triangles[:, [1, 2]], mesh.triangles[:, [2, 0]]])
    forth = {tuple(edge) for edge in edges.tolist()}
    assert len(forth) == len(edges)
    assert forth == {(b, a) for a, b in forth}


def test_boxes_are_closed_and_of_their_size(boxes):
    mesh = box_mesh(boxes)
    assert_closed(mesh)
    assert mesh.triangles.shape == (12 * len(boxes), 3)
    assert mesh.triangles.dtype == np.int32
    np.testing.assert_allclose(volumes(mesh, 12), 8.0 * boxes.half_sizes.prod(axis=1))
    a, b, c = 2.0 * boxes.half_sizes.T
    np.testing.assert_allclose(areas(mesh).reshape(-1, 12).sum(axis=1), 2.0 * (a * b + b * c + c * a))


def test_cylinders_are_closed_and_hold_as_much_as_round_ones(cylinders):
    mesh = cylinder_mesh(cylinders)
    per_solid = 4 * CYLINDER_SIDES
    assert_closed(mesh)
    lengths = np.linalg.norm(cylinders.ends - cylinders.starts, axis=1)
    np.testing.assert_allclose(volumes(mesh, per_solid), np.pi * cylinders.radii**2 * lengths)
    round_areas = 2.0 * np.pi * cylinders.radii * (cylinders.radii + lengths)
    np.testing.assert_allclose(areas(mesh).reshape(-1, per_solid).sum(axis=1), round_areas, rtol=0.004)


def test_height_field_is_the_surface_of_height_at(field, rng):
    mesh = height_field_mesh(field)
    assert mesh.triangles.shape == (2 * 5 * 8, 3)
    np.testing.assert_array_equal(mesh.vertices[:, 2], field.heights.ravel())
    weights = rng.dirichlet(np.ones(3), len(mesh.triangles))
    points = np.einsum("tk,tkj->tj", weights, mesh.vertices[mesh.triangles])
    np.testing.assert_allclose(field.height_at(points[:, :2]), points[:, 2], atol=1e-12)
    np.testing.assert_allclose(field.height_at(mesh.vertices[:, :2]), mesh.vertices[:, 2], atol=1e-12)


def test_height_field_faces_up_and_covers_its_grid_once(field):
    normals = normals_of(height_field_mesh(field))
    np.testing.assert_allclose(normals[:, 2], field.cell_m**2)


def test_world_mesh_holds_everything_that_stands(boxes, cylinders, field):
    route = Route(np.eye(3), 1.0, 1.0, 2.0, 1.0)
    world = World("any", 0, route, boxes, cylinders, (field, field))
    mesh = world_mesh(world)
    parts = [box_mesh(boxes), cylinder_mesh(cylinders), height_field_mesh(field), height_field_mesh(field)]
    assert len(mesh.triangles) == sum(len(part.triangles) for part in parts)
    corners = np.concatenate([part.vertices[part.triangles] for part in parts])
    np.testing.assert_array_equal(mesh.vertices[mesh.triangles], corners)
    assert mesh.triangles.dtype == np.int32
