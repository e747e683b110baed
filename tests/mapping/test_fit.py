"""How well scans at known poses lie on a box, and what is made of it."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, transform_points
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import TrackingConfig
from lidarslam.mapping.surfels.surfel_map import SurfelMap
from lidarslam.mapping.tracking.mapped_scan import Fit, directional_support, measure_fit, translation_information

from .shapes import across_x, on_sides, surfel_map_of

CONFIG = TrackingConfig()
HALF = np.array([7.0, 5.0, 2.0])
T_WORLD_LIDAR = exp([0.0, 0.0, 0.4, 1.0, -0.5, 0.2])


@pytest.fixture
def box_map(rng: np.random.Generator) -> SurfelMap:
    return surfel_map_of(on_sides(rng, HALF, 60_000), 0.2)


@pytest.fixture
def scan_points(rng: np.random.Generator) -> FloatArray:
    """Seen from `T_WORLD_LIDAR`, away from the box's edges."""
    return transform_points(inverse(T_WORLD_LIDAR), on_sides(rng, HALF, 3_000, margin_m=0.5))


def test_a_scan_in_its_place_fits_entirely(box_map, scan_points):
    fit = measure_fit(scan_points, T_WORLD_LIDAR, box_map)
    assert fit.matched == len(scan_points)
    assert fit.overlap == 1.0
    assert fit.inlier_ratio == 1.0
    assert fit.residual_m < 1e-5
    assert fit.status(CONFIG) is Status.OK
    assert fit.explain(CONFIG) == ""


def test_of_points_half_of_which_see_nothing_known_half_overlap(box_map, scan_points):
    elsewhere = scan_points + np.array([0.0, 0.0, 50.0])
    fit = measure_fit(np.concatenate([scan_points, elsewhere]), T_WORLD_LIDAR, box_map)
    assert fit.overlap == pytest.approx(0.5)
    assert fit.inlier_ratio == 1.0
    assert fit.inlier_share == pytest.approx(0.5)


def test_points_at_corners_count_once_each(box_map, rng):
    """Whatever a point there is held against, planes or bodies."""
    points = transform_points(inverse(T_WORLD_LIDAR), on_sides(rng, HALF, 4_000))
    fit = measure_fit(points, T_WORLD_LIDAR, box_map)
    assert fit.matched <= len(points)
    assert 0.8 < fit.overlap <= 1.0


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_worst_axis_decides(box_map, scan_points, axis):
    """A shift by a little more than the gate along one axis of the world: the others' walls all fit."""
    shift = np.eye(4)
    shift[axis, 3] = 0.35
    fit = measure_fit(scan_points, shift @ T_WORLD_LIDAR, box_map)
    assert fit.inlier_ratio < 0.05
    assert fit.status(CONFIG) is Status.LOST
    assert "fits the map" in fit.explain(CONFIG)


def test_a_scan_far_from_everything_does_not_meet_the_map(box_map, scan_points):
    far = np.eye(4)
    far[:3, 3] = 500.0
    fit = measure_fit(scan_points, far, box_map)
    assert fit == Fit(0, 0.0, None, None)
    assert fit.status(CONFIG) is Status.LOST
    assert fit.inlier_share == 0.0
    assert "0 % of the scan overlaps the map" in fit.explain(CONFIG)


@pytest.mark.parametrize(
    ("inlier_ratio", "status"),
    [(1.0, Status.OK), (0.6, Status.OK), (0.59, Status.DEGRADED), (0.45, Status.DEGRADED), (0.44, Status.LOST)],
)
def test_the_share_of_inliers_decides_on_the_status(inlier_ratio, status):
    config = TrackingConfig(degraded_below=0.6, lost_below=0.45)
    assert Fit(1_000, 0.9, 0.01, inlier_ratio).status(config) is status


def test_in_a_young_map_a_scan_that_is_held_is_degraded_at_worst():
    poor = Fit(1_000, 0.9, 0.01, 0.3, support=0.2)
    assert poor.status(CONFIG, is_young=True, is_held=True) is Status.DEGRADED
    assert poor.status(CONFIG, is_young=True) is Status.LOST
    assert poor.status(CONFIG, is_held=True) is Status.LOST


@pytest.mark.parametrize("is_young", [False, True])
def test_a_scan_that_hardly_meets_the_map_is_lost_however_it_fits(is_young):
    hardly = Fit(50, 0.05, 0.001, 1.0)
    assert hardly.status(CONFIG, is_young=is_young, is_held=is_young) is Status.LOST
    assert "5 %" in hardly.explain(CONFIG)


def test_far_points_may_lie_farther_from_their_surface(rng):
    """At 40 m two per cent of the range are 0.8 m; the same offset nearby is none of an inlier."""
    for distance, expected in ((40.0, 1.0), (5.0, 0.0)):
        local_map = surfel_map_of(across_x(rng, distance, 3.0, 20_000), 0.5)
        fit = measure_fit(across_x(rng, distance - 0.4, 2.0, 500), np.eye(4), local_map)
        assert fit.inlier_ratio == expected


def street_normals(rng: np.random.Generator, along: int) -> FloatArray:
    """(N, 3) of ground and facades along x, somewhat rough, and of so many surfaces that face along it."""
    normals = np.zeros((2_000 + 1_000 + along, 3))
    normals[:2_000, 2] = normals[2_000:3_000, 1] = normals[3_000:, 0] = 1.0
    normals += rng.normal(scale=0.03, size=normals.shape)
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def support_of(normals: FloatArray, distances: FloatArray) -> float:
    return directional_support(*translation_information(normals, distances))[0]


def test_of_a_scan_that_slides_along_a_street_what_constrains_it_is_not_supported(rng):
    """One point in twelve shows the slide: the inlier ratio of all hardly changes, the support does.

    In an even tunnel nothing shows a slide; that is a matter of degeneracy, not of the fit.
    """
    normals = street_normals(rng, along=270)
    held, slid = (np.abs(normals @ [distance, 0.0, 0.0]) for distance in (0.05, 3.0))
    assert support_of(normals, held) > 0.99
    assert support_of(normals, slid) < 0.2
    assert np.mean(slid < 1.0) > 0.9
    _, direction = directional_support(*translation_information(normals, slid))
    assert abs(direction[0]) > 0.99
    tunnel = street_normals(rng, along=0)
    assert support_of(tunnel, np.full(len(tunnel), 0.1)) > 0.98


@pytest.mark.parametrize(("support", "status"), [(0.7, Status.OK), (0.45, Status.DEGRADED), (0.2, Status.LOST)])
def test_a_scan_that_may_slide_is_not_ok_however_much_of_it_lies_on_the_map(support, status):
    fit = Fit(1_000, 0.9, 0.01, 0.95, support)
    assert fit.status(CONFIG) is status
    assert ("slide" in fit.explain(CONFIG)) == (status is not Status.OK)
