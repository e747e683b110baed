"""Edges between keyframes hold the motion, and are as sure as what they come from."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, adjoint, exp, inverse
from mapping.pose_graph.edges import Way, trajectory_covariance, trajectory_edges
from mapping.pose_graph.graph_config import TrajectoryEdgeConfig
from mapping.pose_graph.graph_scan import GraphScan

CONFIG = TrajectoryEdgeConfig()
STEP = exp([0.0, 0.1, 0.5, 2.0, -1.0, 0.3])
SIGMA = np.diag([1e-6, 2e-6, 3e-6, 1e-4, 2e-4, 3e-4])


def scan(T_prev_curr: FloatArray | None, lost: bool = False) -> GraphScan:
    covariance = None if T_prev_curr is None else SIGMA
    return GraphScan(np.eye(4), np.zeros((1, 3)), SIGMA, T_prev_curr, covariance, lost=lost, belongs_in_map=True)


def way_of(*scans: GraphScan) -> Way:
    way = Way()
    for one in scans:
        way.go(one, 1.5)
    return way


def test_drift_grows_with_the_way() -> None:
    config = TrajectoryEdgeConfig(
        rotation_deg=0.1, translation_m=0.01, drift_deg_per_m=0.05, drift_percent=1.0, unmapped_factor=3.0
    )
    sigmas = np.sqrt(np.diag(trajectory_covariance(4.0, True, False, config)))
    np.testing.assert_allclose(sigmas, [np.deg2rad(0.3)] * 3 + [0.05] * 3)
    np.testing.assert_allclose(np.sqrt(np.diag(trajectory_covariance(4.0, False, False, config))), 3.0 * sigmas)
    assert trajectory_covariance(4.0, True, True, config)[3, 3] == pytest.approx(9.0)


def test_a_way_adds_up_its_motions_and_their_covariances() -> None:
    way = way_of(scan(STEP), scan(STEP))
    A = adjoint(inverse(STEP))
    assert way.T_keyframe_lidar is not None
    np.testing.assert_allclose(way.T_keyframe_lidar, STEP @ STEP, atol=1e-12)
    np.testing.assert_allclose(way.covariance, A @ SIGMA @ A.T + SIGMA, atol=1e-15)
    assert (way.length_m, way.lost) == (3.0, False)


def test_a_way_with_an_unknown_motion_has_none() -> None:
    way = way_of(scan(STEP), scan(None, lost=True), scan(STEP))
    assert way.T_keyframe_lidar is None
    assert (way.length_m, way.lost) == (4.5, True)


def test_an_edge_is_as_sure_as_both_poses_and_the_drift_between() -> None:
    way, before = way_of(scan(STEP)), 2.0 * SIGMA
    refined, measured = trajectory_edges(7, STEP, way, before, SIGMA, CONFIG)
    assert [(e.first, e.second, e.kind) for e in (refined, measured)] == [(6, 7, "refinement"), (6, 7, "odometry")]
    A = adjoint(inverse(STEP))
    drift = trajectory_covariance(1.5, True, False, CONFIG)
    np.testing.assert_allclose(refined.covariance, drift + SIGMA + A @ before @ A.T, rtol=1e-12)
    np.testing.assert_allclose(measured.covariance, CONFIG.odometry_caution**2 * SIGMA, rtol=1e-12)


def test_where_tracking_was_lost_the_edge_is_loose_whatever_the_poses_say() -> None:
    [edge] = trajectory_edges(1, STEP, way_of(scan(None, lost=True)), SIGMA, SIGMA, CONFIG)
    np.testing.assert_array_equal(edge.covariance, trajectory_covariance(1.5, True, True, CONFIG))


def test_without_a_map_the_odometry_is_told_once() -> None:
    [edge] = trajectory_edges(1, STEP, way_of(scan(STEP)), None, None, CONFIG)
    assert edge.kind == "odometry"
    np.testing.assert_array_equal(edge.covariance, trajectory_covariance(1.5, False, False, CONFIG))
