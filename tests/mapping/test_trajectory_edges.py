"""Edges between keyframes hold the motion, and are as precise as the poses and motions behind them."""

import numpy as np

from lidarslam.core.geometry import FloatArray, adjoint, exp, inverse
from lidarslam.mapping.pose_graph import keyframe_graph
from lidarslam.mapping.pose_graph.keyframe_graph import (
    GraphScan,
    MotionSinceKeyframe,
    drift_covariance,
    trajectory_edges,
)

STEP = exp([0.0, 0.1, 0.5, 2.0, -1.0, 0.3])
SIGMA = np.diag([1e-6, 2e-6, 3e-6, 1e-4, 2e-4, 3e-4])


def scan(T_prev_curr: FloatArray | None, lost: bool = False) -> GraphScan:
    covariance = None if T_prev_curr is None else SIGMA
    return GraphScan(np.eye(4), np.zeros((1, 3)), SIGMA, T_prev_curr, covariance, lost=lost, belongs_in_map=True)


def motion_of(*scans: GraphScan) -> MotionSinceKeyframe:
    motion = MotionSinceKeyframe()
    for one in scans:
        motion = motion.then(one, 1.5)
    return motion


def test_drift_grows_with_the_way():
    sigmas = np.sqrt(np.diag(drift_covariance(4.0)))
    np.testing.assert_allclose(sigmas, [np.deg2rad(0.03 + 4.0 * 0.02)] * 3 + [0.005 + 4.0 * 0.003] * 3)
    np.testing.assert_allclose(np.sqrt(np.diag(drift_covariance(4.0, registered=False))), 5.0 * sigmas)
    assert drift_covariance(4.0, lost=True)[3, 3] == 9.0


def test_motions_are_composed_and_their_covariances_propagated():
    motion = motion_of(scan(STEP), scan(STEP))
    A = adjoint(inverse(STEP))
    np.testing.assert_allclose(motion.T_keyframe_lidar, STEP @ STEP, atol=1e-12)
    np.testing.assert_allclose(motion.covariance, A @ SIGMA @ A.T + SIGMA, atol=1e-15)
    assert (motion.length_m, motion.lost) == (3.0, False)


def test_an_unknown_motion_leaves_none():
    motion = motion_of(scan(STEP), scan(None, lost=True), scan(STEP))
    assert motion.T_keyframe_lidar is None
    assert (motion.length_m, motion.lost) == (4.5, True)


def test_an_edge_is_as_precise_as_both_poses_and_the_drift_between():
    before = 2.0 * SIGMA
    refined, measured = trajectory_edges(7, STEP, motion_of(scan(STEP)), before, SIGMA)
    assert [(e.first, e.second) for e in (refined, measured)] == [(6, 7), (6, 7)]
    A = adjoint(inverse(STEP))
    np.testing.assert_allclose(refined.covariance, drift_covariance(1.5) + SIGMA + A @ before @ A.T, rtol=1e-12)
    np.testing.assert_allclose(measured.covariance, keyframe_graph._ODOMETRY_CAUTION**2 * SIGMA, rtol=1e-12)


def test_where_tracking_was_lost_the_edge_is_loose_whatever_the_covariances_of_the_poses():
    [edge] = trajectory_edges(1, STEP, motion_of(scan(None, lost=True)), SIGMA, SIGMA)
    np.testing.assert_array_equal(edge.covariance, drift_covariance(1.5, lost=True))


def test_without_a_map_the_odometry_counts_once():
    [edge] = trajectory_edges(1, STEP, motion_of(scan(STEP)), None, None)
    np.testing.assert_array_equal(edge.covariance, drift_covariance(1.5, registered=False))


def test_between_two_maps_the_edge_is_that_of_an_odometry():
    """One of them was drawn anew, and surfaces lie elsewhere in it."""
    [edge] = trajectory_edges(1, STEP, motion_of(scan(None)), SIGMA, SIGMA, one_map=False)
    apart = edge.covariance - drift_covariance(1.5, registered=False)
    assert np.linalg.eigvalsh(apart).min() > 0.0
    assert len(trajectory_edges(1, STEP, motion_of(scan(STEP)), SIGMA, SIGMA, one_map=False)) == 2
