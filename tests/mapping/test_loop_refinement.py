"""Fine registration of closures: exact where the scene holds it, and no surer than the prior where it does not."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, log, transform_points
from lidarslam.mapping.loops import refinement
from lidarslam.mapping.loops.closure import LoopClosure
from lidarslam.mapping.loops.refinement import DenseSubmap

from .runs import assert_near
from .shapes import on_boxes

T_TARGET_SOURCE = exp([0.01, -0.02, 0.6, 3.0, -1.5, 0.1])
OFF = exp([0.004, -0.003, 0.006, 0.05, -0.04, 0.03])
PRIOR = np.diag(np.array([np.deg2rad(0.5)] * 3 + [0.05] * 3) ** 2)
DRIFT = np.diag(np.array([np.deg2rad(0.05)] * 3 + [0.005] * 3) ** 2)
CELL_M = 0.2
PILLARS = ((-6.0, 2.0), (-1.0, -3.0), (5.0, 1.0))
NOISE_M = 0.01


def refine(
    target: DenseSubmap, source: DenseSubmap, T: FloatArray, covariance: FloatArray, drift: FloatArray
) -> LoopClosure | None:
    closure = LoopClosure(0, 1, T, covariance, 0.9, 0.01, 0.9, False, 0, "")
    return refinement.refine(target, source, closure, drift)


def planes(rng: np.random.Generator, ends: bool) -> FloatArray:
    """Points on floor, ceiling and walls of a hall of 20 x 8 x 3 m, and on its ends and some pillars."""
    hall, pillars = ((0.0, 0.0, 1.5), (10.0, 4.0, 1.5)), [((x, y, 1.5), (0.4, 0.4, 1.5)) for x, y in PILLARS]
    cloud = on_boxes([hall, *pillars] if ends else [hall], 1.0 / 60.0, rng)
    if not ends:
        cloud = cloud[np.abs(cloud[:, 0]) < 10.0]
    return np.asarray(cloud + rng.normal(scale=NOISE_M, size=cloud.shape))


def submaps(ends: bool = True, seed: int = 3) -> tuple[DenseSubmap, DenseSubmap]:
    """Two of the same hall, each with points of its own, the target at the hall's middle."""
    rng = np.random.default_rng(seed)
    target = DenseSubmap.join([(np.eye(4), planes(rng, ends))], 60.0, CELL_M)
    source = transform_points(inverse(T_TARGET_SOURCE), planes(rng, ends))
    return target, DenseSubmap.join([(np.eye(4), source)], 60.0, CELL_M)


@pytest.mark.parametrize("seed", [0, 3])
def test_a_pose_that_is_centimetres_off_comes_to_within_millimetres_and_its_covariance(seed):
    refined = refine(*submaps(seed=seed), T_TARGET_SOURCE @ OFF, PRIOR, DRIFT)
    assert_near(refined.T_first_second, T_TARGET_SOURCE, 0.003, 0.03)
    xi = log(inverse(refined.T_first_second) @ T_TARGET_SOURCE)
    assert xi @ np.linalg.solve(refined.covariance, xi) < 16.8
    assert (np.diag(refined.covariance) < 0.1 * np.diag(PRIOR)).all()


def test_neither_side_is_preferred():
    target, source = submaps()
    there = refine(target, source, T_TARGET_SOURCE @ OFF, PRIOR, DRIFT)
    back = refine(source, target, inverse(T_TARGET_SOURCE @ OFF), PRIOR, DRIFT)
    np.testing.assert_allclose(there.T_first_second @ back.T_first_second, np.eye(4), atol=1e-3)


def test_along_a_corridor_little_is_known():
    def sigma_m(ends: bool) -> float:
        refined = refine(*submaps(ends), T_TARGET_SOURCE, PRIOR, DRIFT)
        along = T_TARGET_SOURCE[0, :3]  # the hall's axis in the source's frame
        return float(np.sqrt(along @ (refined.covariance - DRIFT)[3:, 3:] @ along))

    assert sigma_m(ends=False) > max(3.0 * sigma_m(ends=True), 0.2 * np.sqrt(PRIOR[3, 3]))


def test_what_contradicts_the_verified_pose_is_refused():
    target, source = submaps()
    assert refine(target, source, T_TARGET_SOURCE @ OFF, 1e-2 * PRIOR, DRIFT) is None


@pytest.mark.parametrize("count", [0, 40])
def test_next_to_nothing_is_not_registered(count):
    target, _ = submaps()
    few = DenseSubmap.join([(np.eye(4), np.random.default_rng(0).uniform(size=(count, 3)))], 60.0, CELL_M)
    far = exp([0.0, 0.0, 0.0, 0.0, 0.0, 500.0])
    assert refine(few, few, far, PRIOR, DRIFT) is None
    assert refine(target, few, far, PRIOR, DRIFT) is None


def test_neighbours_are_joined_where_they_lie():
    points = planes(np.random.default_rng(1), ends=True)
    left, right = points[points[:, 0] < 0.0], points[points[:, 0] >= 0.0]
    T = exp([0.1, 0.2, -0.3, 4.0, 5.0, 0.6])
    joined = DenseSubmap.join([(np.eye(4), left), (T, transform_points(inverse(T), right))], 60.0, CELL_M)
    whole = DenseSubmap.join([(np.eye(4), np.concatenate([left, right]))], 60.0, CELL_M)
    np.testing.assert_allclose(joined.points, whole.points, atol=1e-9)
    assert np.linalg.norm(DenseSubmap.join([(np.eye(4), points)], 5.0, CELL_M).points, axis=1).max() <= 5.0
