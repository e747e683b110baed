"""Rays meet what formulas say they meet."""

import numpy as np
import pytest

from lidarslam.simulation.mesh import Caster, box_mesh, meet_boxes
from lidarslam.simulation.world import Boxes, Mover, Route, World

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


def test_a_mover_behind_a_wall_is_not_seen():
    car = Boxes(np.array([[0.0, 0.0, 0.5]]), np.array([[1.0, 0.5, 0.5]]), np.eye(3)[None])
    mover = Mover(car, np.array([[20.0, 0.0, 0.0]]), speed_mps=0.0, start_m=0.0)
    hits = Caster(box_world(movers=(mover,))).cast(
        np.array([[0.0, 0.0, 0.5]]), np.array([[1.0, 0.0, 0.0]]), np.zeros(1), 100.0
    )
    assert not hits.moving.any()


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
    box = Boxes(np.zeros((1, 3)), np.ones((1, 3)), np.eye(3)[None])
    origins = np.array([[-5.0, 0.5, 0.5], [-5.0, 1.5, 0.0], [5.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    distances, _ = meet_boxes(box, origins, np.tile([1.0, 0.0, 0.0], (4, 1)))
    np.testing.assert_array_equal(distances, [4.0, np.inf, np.inf, np.inf])  # the last starts inside
