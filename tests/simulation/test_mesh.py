"""Triangles of the primitives: closed, outward, of the right size; rays meet what formulas say; movers go round."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import is_rigid
from lidarslam.simulation.mesh import (
    CYLINDER_SIDES,
    Caster,
    Mesh,
    box_mesh,
    cylinder_mesh,
    height_field_mesh,
    meet_boxes,
    world_mesh,
)
from lidarslam.simulation.world import Boxes, Cylinders, HeightField, Mover, Route, World


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


def test_height_field_is_the_surface_of_height_at_which_goes_on_level_outside_its_grid(field, rng):
    mesh = height_field_mesh(field)
    assert mesh.triangles.shape == (2 * 5 * 8, 3)
    np.testing.assert_array_equal(mesh.vertices[:, 2], field.heights.ravel())
    weights = rng.dirichlet(np.ones(3), len(mesh.triangles))
    points = np.einsum("tk,tkj->tj", weights, mesh.vertices[mesh.triangles])
    np.testing.assert_allclose(field.height_at(points[:, :2]), points[:, 2], atol=1e-12)
    np.testing.assert_allclose(field.height_at(mesh.vertices[:, :2]), mesh.vertices[:, 2], atol=1e-12)
    np.testing.assert_allclose(normals_of(mesh)[:, 2], field.cell_m**2)  # it faces up and covers its grid once
    small = HeightField(np.zeros(2), 1.0, np.array([[0.0, 1.0], [2.0, 3.0]]))
    np.testing.assert_allclose(small.height_at(np.array([[-5.0, -5.0], [9.0, 9.0], [9.0, 0.0]])), [0.0, 3.0, 2.0])


def test_world_mesh_holds_everything_that_stands(boxes, cylinders, field):
    route = Route(np.eye(3), 1.0, 1.0, 2.0, 1.0)
    world = World("any", 0, route, boxes, cylinders, (field, field))
    mesh = world_mesh(world)
    parts = [box_mesh(boxes), cylinder_mesh(cylinders), height_field_mesh(field), height_field_mesh(field)]
    assert len(mesh.triangles) == sum(len(part.triangles) for part in parts)
    corners = np.concatenate([part.vertices[part.triangles] for part in parts])
    np.testing.assert_array_equal(mesh.vertices[mesh.triangles], corners)
    assert mesh.triangles.dtype == np.int32


UNIT_BOX = Boxes(np.zeros((1, 3)), np.ones((1, 3)), np.eye(3)[None])
ROUTE = Route(np.array([[0.0, 0, 0], [5, 0, 0], [0, 5, 0]]), 1.0, 1.0, 3.0, 1.0)


def box_world(shift=0.0, movers=()):
    boxes = Boxes(np.array([[10.0 + shift, shift, 0.0]]), np.array([[1.0, 2.0, 3.0]]), np.eye(3)[None])
    return World("box", 0, ROUTE, boxes, movers=movers)


@pytest.mark.parametrize("shift", [0.0, 5_000.0])
def test_hits_have_range_normal_and_cosine(shift):
    origins = np.tile([shift, shift, 0.0], (3, 1))
    slanted = np.array([9.0, 1.5, 1.0])
    directions = np.stack([[1.0, 0.0, 0.0], slanted / np.linalg.norm(slanted), [0.0, 1.0, 0.0]])
    hits = Caster(box_world(shift)).cast(origins, directions, np.zeros(3), 100.0)
    np.testing.assert_allclose(hits.ranges[:2], [9.0, np.linalg.norm(slanted)], atol=1e-5)
    np.testing.assert_allclose(hits.normals, [[-1, 0, 0], [-1, 0, 0], [0, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(hits.cosines, [1.0, 9.0 / np.linalg.norm(slanted), 0.0], atol=1e-6)
    assert np.isinf(hits.ranges[2])
    assert (hits.surfaces >= 0).tolist() == [True, True, False]
    too_near = Caster(box_world(shift)).cast(origins, directions, np.zeros(3), 8.9)
    assert np.isinf(too_near.ranges).all()
    assert not hits.moving.any()


def test_movers_are_met_where_they_are_at_the_ray_s_time():
    car = Boxes(np.array([[0.0, 0.0, 0.5]]), np.array([[1.0, 0.5, 0.5]]), np.eye(3)[None])
    there_and_back = np.array([[4.0, -20.0, 0.0], [4.0, 20.0, 0.0]])
    mover = Mover(car, there_and_back, speed_mps=10.0, start_m=0.0)
    times = np.array([0.0, 1.85, 1.95, 2.05, 2.15])  # at 2 s it passes y = 0, two metres long
    origins, directions = np.tile([0.0, 0.0, 0.5], (5, 1)), np.tile([1.0, 0.0, 0.0], (5, 1))
    hits = Caster(box_world(movers=(mover,))).cast(origins, directions, times, 100.0)
    np.testing.assert_allclose(hits.ranges, [9.0, 9.0, 3.5, 3.5, 9.0], atol=1e-5)
    assert hits.moving.tolist() == [False, False, True, True, False]
    assert hits.surfaces[2] == -2
    np.testing.assert_allclose(hits.normals[2], [-1.0, 0.0, 0.0], atol=1e-6)
    hidden = Mover(car, np.array([[20.0, 0.0, 0.0]]), speed_mps=0.0, start_m=0.0)
    assert not Caster(box_world(movers=(hidden,))).cast(origins, directions, times, 100.0).moving.any()


def test_boxes_by_formula_agree_with_their_mesh(rng):
    turns = np.linalg.qr(rng.normal(size=(5, 3, 3)))[0]
    turns *= np.sign(np.linalg.det(turns))[:, None, None]
    boxes = Boxes(rng.uniform(-5.0, 5.0, (5, 3)), rng.uniform(0.3, 1.5, (5, 3)), turns)
    origins = np.tile([0.0, 0.0, 12.0], (4000, 1))
    directions = rng.uniform(-6.0, 6.0, (4000, 3)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distances, normals = meet_boxes(boxes, origins, directions)
    world = World("boxes", 0, ROUTE, boxes)
    hits = Caster(world, box_mesh(boxes)).cast(origins, directions, np.zeros(4000), 100.0)
    met = np.isfinite(distances)
    assert 300 < met.sum() < 3900
    grazing = met != np.isfinite(hits.ranges)
    assert grazing.sum() <= 2
    both = met & ~grazing
    assert np.quantile(np.abs(distances[both] - hits.ranges[both]), 0.999) < 1e-4
    assert np.median(np.abs(normals - hits.normals)[both]) < 1e-5


def test_rays_along_an_axis_meet_boxes():
    origins = np.array([[-5.0, 0.5, 0.5], [-5.0, 1.5, 0.0], [5.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    distances, _ = meet_boxes(UNIT_BOX, origins, np.tile([1.0, 0.0, 0.0], (4, 1)))
    np.testing.assert_array_equal(distances, [4.0, np.inf, np.inf, np.inf])  # the last starts inside


def test_a_mover_goes_round_at_its_speed_and_looks_where_it_goes():
    """Round a rectangle of 10 m by 5 m on a slope, counter-clockwise."""
    corners = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 1.0], [10.0, 5.0, 1.0], [0.0, 5.0, 0.0]])
    mover = Mover(UNIT_BOX, corners, 2.0, 3.0)
    period = (2.0 * 5.0 + 2.0 * np.sqrt(101.0)) / mover.speed_mps
    poses = mover.pose_at(np.linspace(0.0, 3.0 * period, 40001))
    assert is_rigid(poses)
    np.testing.assert_allclose(poses[-1], poses[0], atol=1e-9)
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    expected = 3.0 * period / 40000 * mover.speed_mps
    assert steps.max() <= expected * (1.0 + 1e-6)
    np.testing.assert_allclose(np.median(steps), expected)
    poses = mover.pose_at(np.array([0.0, 4.5, 7.5]))
    np.testing.assert_allclose(poses[0, :3, 3], 3.0 / np.sqrt(101.0) * np.array([10.0, 0.0, 1.0]))
    np.testing.assert_allclose(poses[:, :2, 0], [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(poses[:, :3, 2], np.broadcast_to([0.0, 0.0, 1.0], (3, 3)))
