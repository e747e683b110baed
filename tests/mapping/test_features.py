"""Edges lie on the corners of a room, planes on its surfaces, and nothing depends on the mounting."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from mapping.loam.config import FeatureConfig
from mapping.loam.features import Features, extract_features
from mapping.loam.rings import RingFinder

Scanner = Callable[..., Scan]
ALL_PLANES = FeatureConfig(plane_cell_m=0.0)
STAND = np.array([0.7, -0.4, 1.3])
# The room of conftest.py and the box in it: x, y of their vertical edges.
ROOM = np.array([[x, y] for x in (-5.0, 5.0) for y in (-4.0, 4.0)])
BOX = np.array([[3.0, 0.0], [3.0, 1.0], [3.5, 0.0]])
# The one past which the wall behind is seen; at the third the box's side lies along the beam.
SILHOUETTE = BOX[1]


def distance_to_corner(points: FloatArray) -> FloatArray:
    """Distance (N,) from the nearest line in which two surfaces of the room meet, or a vertical edge of the box."""
    beside = np.linalg.norm(points[:, None, :2] - np.concatenate([ROOM, BOX]), axis=2).min(axis=1)
    wall = np.abs(np.abs(points[:, :2]) - [5.0, 4.0]).min(axis=1)
    outside = np.maximum(np.abs(points[:, :2] - [3.25, 0.5]) - [0.25, 0.5], 0.0)
    upright = np.minimum(wall, np.linalg.norm(outside, axis=1))
    level = np.minimum(np.abs(points[:, 2]), np.abs(points[:, 2] - 3.0))
    return np.minimum(beside, np.hypot(upright, level))


def same(a: Features, b: Features) -> bool:
    return all(np.array_equal(getattr(a, k), getattr(b, k)) for k in ("edges", "planes", "sharp", "flat"))


@pytest.mark.parametrize("sensor", ["vlp-16", "hdl-64e", "os1-64", "xt32"])
@pytest.mark.parametrize("sigma_m", [0.0, 0.01])
def test_edges_lie_on_corners_and_planes_off_them(scan_room: Scanner, sensor: str, sigma_m: float) -> None:
    scan = scan_room(sensor, sigma_m=sigma_m)
    found = extract_features(scan.points, scan.rings, FeatureConfig())
    edges = scan.points[found.edges] + STAND
    assert len(edges) > 60
    assert np.mean(distance_to_corner(edges) < 0.15) > 0.97
    assert distance_to_corner(scan.points[found.sharp] + STAND).mean() < 0.06
    # Every upright corner of the room that is in sight is found.
    for corner in ROOM:
        assert np.count_nonzero(np.linalg.norm(edges[:, :2] - corner, axis=1) < 0.15) >= 5
    planes = distance_to_corner(scan.points[found.planes] + STAND)
    assert len(planes) > 800
    # A ring that runs along the foot of a wall comes close to it without a bend.
    assert np.mean(planes > 0.05) > 0.9


def test_the_near_side_of_a_step_is_an_edge_and_the_far_side_is_none(scan_room: Scanner) -> None:
    scan = scan_room("os1-64")
    edges = scan.points[extract_features(scan.points, scan.rings, FeatureConfig()).edges] + STAND
    assert np.count_nonzero(np.linalg.norm(edges[:, :2] - SILHOUETTE, axis=1) < 0.1) >= 20
    for corner in BOX[1:]:
        # Where the ray past this corner meets the wall behind.
        shadow = STAND[:2] + (corner - STAND[:2]) * (5.0 - STAND[0]) / (corner[0] - STAND[0])
        behind = (np.abs(edges[:, 0] - 5.0) < 0.02) & (np.abs(edges[:, 1] - shadow[1]) < 0.2)
        # Edges between wall and floor or ceiling remain.
        assert not (behind & (edges[:, 2] > 0.1) & (edges[:, 2] < 2.9)).any()


def turned(scan: Scan, rotation: Rotation) -> FloatArray:
    return np.asarray(rotation.apply(scan.points))


@pytest.mark.parametrize("rotation_vector", [[np.pi, 0.0, 0.0], [0.4, -1.1, 2.0]])
def test_a_rotation_of_the_frame_changes_nothing(scan_room: Scanner, rotation_vector: list[float]) -> None:
    scan = scan_room("vlp-16")
    upright = extract_features(scan.points, scan.rings, ALL_PLANES)
    rotated = extract_features(turned(scan, Rotation.from_rotvec(rotation_vector)), scan.rings, ALL_PLANES)
    np.testing.assert_array_equal(rotated.sharp, upright.sharp)
    # Single precision decides a few points on the thresholds otherwise.
    for kind in ("edges", "planes"):
        differing = np.setxor1d(getattr(upright, kind), getattr(rotated, kind))
        assert len(differing) <= 0.002 * len(getattr(upright, kind))


def test_features_of_a_sensor_upside_down(scan_room: Scanner) -> None:
    scan = scan_room("os1-64", "upside-down")
    rings = RingFinder().rings(scan.points, None)
    found = extract_features(scan.points, rings, FeatureConfig())
    edges = scan.points[found.edges] * [1.0, -1.0, -1.0] + STAND
    assert len(edges) > 200
    assert np.mean(distance_to_corner(edges) < 0.15) > 0.97


def test_the_numbering_of_rings_does_not_matter(scan_room: Scanner, rng: np.random.Generator) -> None:
    scan = scan_room("os1-64", sigma_m=0.01)
    renumbered = rng.permutation(64)[scan.rings]
    config = FeatureConfig()
    assert same(extract_features(scan.points, scan.rings, config), extract_features(scan.points, renumbered, config))


def test_the_order_of_storage_does_not_matter(scan_room: Scanner, rng: np.random.Generator) -> None:
    scan = scan_room("vlp-16")
    assert scan.rings is not None
    expected = extract_features(scan.points, scan.rings, ALL_PLANES)
    by_ring = np.argsort(scan.rings, kind="stable")
    found = extract_features(scan.points[by_ring], scan.rings[by_ring], ALL_PLANES)
    np.testing.assert_array_equal(np.sort(by_ring[found.edges]), expected.edges)
    # Shuffled, the rings begin at another azimuth, and with them the sectors and every second point.
    shuffled = scan.select(rng.permutation(len(scan)))
    edges = shuffled.points[extract_features(shuffled.points, shuffled.rings, ALL_PLANES).edges] + STAND
    assert 0.9 < len(edges) / len(expected.edges) < 1.1
    assert np.mean(distance_to_corner(edges) < 0.15) > 0.97


def test_a_wall_along_the_beam_makes_no_edges() -> None:
    """A street's wall 2 m aside, seen up to 60 m ahead at one ring of 0.2 degrees."""
    azimuth = np.deg2rad(np.arange(2.0, 178.0, 0.2))
    ranges = 2.0 / np.sin(azimuth)
    points = np.stack([ranges * np.cos(azimuth), ranges * np.sin(azimuth), np.zeros_like(azimuth)], axis=1)
    found = extract_features(points, np.zeros(len(points), dtype=np.int32), ALL_PLANES)
    assert not len(found.edges)
    # sin(azimuth) = 1/4 is where steps become four times as long as head-on, squared by the slant.
    assert np.abs(points[found.planes, 0]).max() < 10.0
    assert len(found.planes) > 100


def test_noise_makes_no_edges(rng: np.random.Generator) -> None:
    """Walls at 30 m with 6 cm of noise: LOAM's threshold alone would pick one point in seven."""
    azimuth = np.tile(np.deg2rad(np.arange(60.0, 120.0, 0.2)), 20)
    ranges = 30.0 / np.sin(azimuth) + rng.normal(0.0, 0.06, len(azimuth))
    points = np.stack([ranges * np.cos(azimuth), ranges * np.sin(azimuth), np.zeros_like(azimuth)], axis=1)
    rings = np.repeat(np.arange(20), len(azimuth) // 20)
    assert len(extract_features(points, rings, FeatureConfig()).edges) < 0.01 * len(points)
    assert len(extract_features(points, rings, FeatureConfig(edge_over_noise=0.0)).edges) > 0.05 * len(points)


def test_points_on_either_side_of_a_hole_are_no_neighbours() -> None:
    """Take a sector of a round wall out: its two ends are joined by no curve, so nothing bends there."""
    azimuth = np.deg2rad(np.arange(0.0, 360.0, 0.2))
    points = 8.0 * np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)], axis=1)
    kept = (azimuth < 1.0) | (azimuth > 1.5)
    rings = np.zeros(np.count_nonzero(kept), dtype=np.int32)
    found = extract_features(points[kept], rings, ALL_PLANES)
    assert not len(found.edges)
    near_hole = (azimuth[kept] > 0.99) & (azimuth[kept] < 1.51)
    assert not near_hole[found.planes].any()
    # The ring closes: there are planes on either side of its ends.
    assert {0, len(rings) - 1} <= set(found.planes)
    trusting = extract_features(points[kept], rings, FeatureConfig(max_gap_columns=1000.0))
    assert near_hole[trusting.planes].any()


def test_quotas_hold(scan_room: Scanner) -> None:
    scan = scan_room("hdl-64e")
    few = FeatureConfig(sectors=4, edges_per_sector=2, sharp_per_sector=1, flat_per_sector=3)
    found = extract_features(scan.points, scan.rings, few)
    assert scan.rings is not None
    assert np.bincount(scan.rings[found.edges]).max() <= 8
    assert np.bincount(scan.rings[found.sharp]).max() <= 4
    assert np.bincount(scan.rings[found.flat]).max() <= 12
    assert set(found.sharp) <= set(found.edges)
    assert set(found.flat) <= set(found.planes)
    assert not set(found.edges) & set(found.planes)


def test_strays_are_left_out(scan_room: Scanner) -> None:
    scan = scan_room("vlp-16")
    assert scan.rings is not None
    rings = np.where(scan.rings < 4, -1, scan.rings)
    found = extract_features(scan.points, rings, FeatureConfig())
    assert scan.rings[np.concatenate([found.edges, found.planes])].min() == 4


@pytest.mark.parametrize("count", [0, 1, 2, 9, 11])
@pytest.mark.parametrize("with_rings", [True, False])
def test_hardly_any_points(rng: np.random.Generator, count: int, with_rings: bool) -> None:
    points = rng.normal(0.0, 5.0, (count, 3))
    found = extract_features(points, np.zeros(count, dtype=np.int32) if with_rings else None, FeatureConfig())
    assert max(len(found.edges), len(found.planes)) <= count


@pytest.mark.parametrize("sigma_m", [0.0, 0.01])
def test_planes_without_rings(scan_room: Scanner, sigma_m: float) -> None:
    scan = scan_room("livox", sigma_m=sigma_m)
    found = extract_features(scan.points, None, FeatureConfig())
    assert not len(found.edges)
    assert len(found.planes) > 500
    planes = distance_to_corner(scan.points[found.planes] + STAND)
    assert np.mean(planes > 0.1) > 0.97
