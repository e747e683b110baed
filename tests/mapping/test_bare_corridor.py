"""A corridor whose length only the faces of a few boxes show."""

from dataclasses import replace

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, log, transform_points
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.motion.prediction import UNKNOWN_VELOCITY, MotionState, Prediction
from lidarslam.mapping.registration.registration import register
from lidarslam.mapping.registration.sampled_scan import SampledScan, sizes_of_cells
from lidarslam.mapping.surfels.surfel_map import SurfelMap, constraining_points
from lidarslam.mapping.tracking.budget import Budget
from lidarslam.mapping.tracking.fit import Fit, measure_fit
from lidarslam.mapping.tracking.scan_matcher import ScanMatcher

from .shapes import elevations_of, on_sides, surfel_map_of

CELL = 0.1
NOISE_M = 0.008
# x, and side of the corridor.
FACES = ((2.0, 1.0), (-2.5, -1.0), (3.5, -1.0), (-4.0, 1.0))
T_TRUE = exp([0.0, 0.01, 0.05, 0.3, 0.1, -0.05])


def scene(rng: np.random.Generator, on_walls: int, on_each_face: int) -> FloatArray:
    """Points on walls, floor and ceiling of 12 m, 2.4 m wide and high, then on each face of 0.4 x 0.6 m."""
    parts = [on_sides(rng, np.array([6.0, 1.2, 1.2]), on_walls, (1, 2))]
    for x, side in FACES:
        y, z = rng.uniform(0.8, 1.2, on_each_face) * side, rng.uniform(-1.2, -0.6, on_each_face)
        parts.append(np.column_stack([np.full(on_each_face, x), y, z]))
    points = np.concatenate(parts)
    return points + rng.normal(scale=NOISE_M, size=points.shape)


@pytest.fixture
def corridor(rng: np.random.Generator) -> SurfelMap:
    return surfel_map_of(scene(rng, 120_000, 1_000), CELL)


@pytest.fixture
def keypoints(rng: np.random.Generator) -> FloatArray:
    """In the LiDAR frame at `T_TRUE`; one in a hundred is on a face."""
    return transform_points(inverse(T_TRUE), scene(rng, 3_000, 8))


@pytest.fixture
def without_faces(rng: np.random.Generator) -> tuple[SurfelMap, FloatArray]:
    """A map of walls alone, and keypoints on them."""
    keypoints = transform_points(inverse(T_TRUE), scene(rng, 3_000, 0))
    return surfel_map_of(scene(rng, 120_000, 0), CELL), keypoints


def test_the_points_on_the_faces_have_the_leverage(rng):
    points = scene(rng, 40_000, 60)
    chosen = constraining_points(points, elevations_of(points), 0.5 * CELL, 1_000)
    on_face = chosen >= 40_000
    assert on_face.sum() > 0.25 * 60 * len(FACES)
    assert on_face.mean() > 0.6
    assert len(constraining_points(points, elevations_of(points), 0.5 * CELL, 50)) == 50


def test_where_everything_constrains_no_point_does_more_than_others(rng):
    points = on_sides(rng, np.full(3, 3.0), 40_000)
    assert len(constraining_points(points, elevations_of(points), 0.5 * CELL, 1_000)) < 40


@pytest.mark.parametrize("off_m", [-0.2, -0.12, 0.12, 0.2])
def test_faces_hold_the_length_although_walls_fit_anywhere(corridor, keypoints, off_m):
    """The few residuals along the corridor are no outliers while the prediction leaves its length open."""
    sigmas = np.array([0.02] * 3 + [0.3, 0.03, 0.03] + [0.1] * 6)
    start = Prediction(0.0, T_TRUE @ exp([0.0, 0.0, 0.0, off_m, 0.0, 0.0]), np.zeros(6), np.diag(sigmas**2))
    found = register(Sweep(keypoints), start, corridor, with_velocity=False)
    assert np.linalg.norm(log(inverse(T_TRUE) @ found.T_world_lidar)[3:]) < 0.015


def fit_at(off_m: float, keypoints: FloatArray, surfel_map: SurfelMap) -> Fit:
    return measure_fit(keypoints, T_TRUE @ exp([0.0, 0.0, 0.0, off_m, 0.0, 0.0]), surfel_map)


def test_a_scan_that_slid_has_no_evidence_of_the_length_nor_has_one_without_faces(corridor, keypoints, without_faces):
    held, slid = (fit_at(off_m, keypoints, corridor) for off_m in (0.0, 0.5))
    assert held.is_constrained
    assert abs(held.weakest[0]) > 0.99
    assert not slid.is_constrained
    assert slid.inlier_ratio == pytest.approx(held.inlier_ratio, abs=0.2)
    bare_map, bare = without_faces
    assert not fit_at(0.0, bare, bare_map).is_constrained


def test_what_nothing_constrains_keeps_the_imus_prediction(without_faces):
    """As uncertain as it was, and it is no measurement."""
    bare_map, bare = without_faces
    sampled = SampledScan(0.1, sizes_of_cells(CELL), 3.0, Sweep(bare), elevations_of(bare), Sweep(bare))
    sigmas = np.array([0.02] * 3 + [0.1, 0.03, 0.03] + [0.1] * 6)
    start = Prediction(0.1, T_TRUE @ exp([0.0, 0.0, 0.01, 0.0, 0.02, 0.0]), np.zeros(6), np.diag(sigmas**2))
    last = MotionState(0.0, np.eye(4), np.zeros(6), UNKNOWN_VELOCITY)
    matcher = ScanMatcher(sampled, last, bare_map, MappingConfig(), Budget())
    found = matcher.register(replace(start, is_inertial=True), coarse_first=False).registration
    error = log(inverse(T_TRUE) @ found.T_world_lidar)
    assert np.linalg.norm(error[3:]) < 0.005
    along = np.concatenate([np.zeros(3), found.T_world_lidar[:3, :3].T @ [1.0, 0.0, 0.0]])
    assert np.sqrt(along @ found.covariance[:6, :6] @ along) == pytest.approx(0.1, rel=0.05)
    assert along @ found.measured.information @ along < 10.0
    assert found.measured.information[4, 4] > 1e4
