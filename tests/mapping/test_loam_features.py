"""Rings of a sweep, and its edge and planar features: curvature, reliability and choice."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.loam.features import EDGE, PLANE, FeatureSampler, classify, ring_order, write_curvatures
from lidarslam.mapping.motion.deskew import Sweep

FINE_M = 0.02  # voxels of single points


def extract_features(scan: Scan, min_range_m: float, max_range_m: float, cell_m: float) -> tuple[Sweep, Sweep]:
    """Edges and planar points for a map with such cells."""
    config = MappingConfig(method="loam", cell_m=cell_m, min_range_m=min_range_m, max_range_m=max_range_m)
    sweep = FeatureSampler(config).sample(scan).sweep
    return sweep.take(np.flatnonzero(sweep.kinds == EDGE)), sweep.take(np.flatnonzero(sweep.kinds == PLANE))


def on_sphere(azimuth: FloatArray, elevation: FloatArray, ranges: FloatArray | float = 5.0) -> FloatArray:
    """Points (N, 3) in these directions, radians."""
    rays = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    return np.stack(rays, axis=-1) * np.reshape(ranges, (-1, 1))


def test_rings_of_the_recording_are_kept(rng):
    rings = rng.integers(0, 7, 500).astype(np.int32)
    order, found = ring_order(Scan(rng.normal(size=(500, 3)), 0.0, rings=rings))
    np.testing.assert_array_equal(found, np.sort(rings))
    np.testing.assert_array_equal(found, rings[order])
    for ring in range(7):
        np.testing.assert_array_equal(order[found == ring], np.flatnonzero(rings == ring))


def test_points_of_a_ring_are_in_the_order_of_time(room, drive, scan_room, rng):
    """However they are stored, and whether rings are numbered or not."""
    for scan in (room.ring_sweep(drive, 0.1, rings=8, columns=100), replace(scan_room("vlp-16"), rings=None)):
        shuffled = scan.select(rng.permutation(len(scan)))
        (order, rings), (again, same) = ring_order(scan), ring_order(shuffled)
        np.testing.assert_array_equal(rings, same)
        np.testing.assert_array_equal(scan.points[order], shuffled.points[again])


@pytest.mark.parametrize("start_deg", [0.0, 180.0], ids=["ahead", "behind"])
@pytest.mark.parametrize("way", [1, -1], ids=["counter-clockwise", "clockwise"])
def test_rings_stored_one_after_the_other_are_found(start_deg, way, rng):
    """In a cloud as KITTI's, 40 rings from the top, each once round, a fifth of its points missing."""
    azimuth = np.deg2rad(start_deg) + way * 2.0 * np.pi * (np.arange(500) + 0.5) / 500
    rings = np.arange(40).repeat(500)
    elevation = np.deg2rad(2.0 - 0.6 * rings + rng.uniform(-0.1, 0.1, len(rings)))
    points = on_sphere(np.tile(azimuth, 40), elevation, rng.uniform(4.0, 20.0, len(rings)))
    kept = np.flatnonzero(rng.uniform(size=len(rings)) > 0.2)
    order, found = ring_order(Scan(points[kept], 0.0))
    np.testing.assert_array_equal(order, np.arange(len(kept)))
    np.testing.assert_array_equal(found, rings[kept])


@pytest.mark.parametrize("sensor", ["vlp-16", "hdl-32e", "os1-64", "xt32"])
def test_rings_of_a_cloud_in_firing_order_are_found(scan_room, sensor):
    scan = scan_room(sensor)
    order, found = ring_order(replace(scan, rings=None))
    np.testing.assert_array_equal(np.sort(order), np.arange(len(scan)))
    assert (np.diff(found) >= 0).all()
    true = scan.rings[order]
    # Numbered from below; the drivers number some from above.
    np.testing.assert_array_equal(found, true if true[0] == 0 else true.max() - true)
    assert (np.diff(scan.time_offsets[order])[np.diff(found) == 0] >= 0.0).all()
    order, found = ring_order(replace(scan, rings=None, time_offsets=None))
    azimuth = np.arctan2(scan.points[order, 1], scan.points[order, 0])
    assert (np.diff(azimuth)[np.diff(found) == 0] >= 0.0).all()


def test_elevations_without_peaks_are_divided_into_rows(rng):
    """Three peaks are not enough: rows of half a degree."""
    azimuth, which = rng.uniform(-np.pi, np.pi, 900), rng.integers(0, 3, 900)
    for elevations_deg, expected in (([-1.3, -1.2, 0.2], [0, 1, 2]), ([-1.1, -0.9, 0.2], [0, 0, 1])):
        order, rings = ring_order(Scan(on_sphere(azimuth, np.deg2rad(elevations_deg)[which]), 0.0))
        np.testing.assert_array_equal(np.sort(order), np.arange(900))
        np.testing.assert_array_equal(np.unique(rings, return_inverse=True)[1], np.array(expected)[which[order]])


@pytest.mark.parametrize("count", [0, 1, 2, 10, 11])
@pytest.mark.parametrize("has_rings", [True, False])
def test_scans_of_few_points(count, has_rings, rng):
    rings = rng.integers(0, 2, count).astype(np.int32) if has_rings else None
    scan = Scan(rng.normal(size=(count, 3)), 0.0, np.zeros(count), rings)
    order, found = ring_order(scan)
    np.testing.assert_array_equal(np.sort(order), np.arange(count))
    assert found.shape == (count,)
    edges, planes = extract_features(scan, 0.0, 100.0, 0.1)
    if count <= 10:
        assert len(edges) == len(planes) == 0, "a curvature needs ten neighbours"


def test_all_points_of_a_rosette_may_lie_on_planes(scan_room):
    """The strokes of a sensor without rings are no edges."""
    edges, planes = extract_features(scan_room("livox"), 0.5, 100.0, 0.1)
    assert len(edges) == 0
    assert len(planes) > 500


def curvatures(points: FloatArray, rings: NDArray[np.intp] | None = None) -> FloatArray:
    found = np.full(len(points), 7.0)
    write_curvatures(points, np.zeros(len(points), dtype=np.intp) if rings is None else rings, found)
    return found


@pytest.mark.parametrize("angle_deg", [30.0, 90.0, 150.0])
def test_the_curvature_of_a_corner(angle_deg):
    """The sides' sums are 15 steps of 5 cm along either."""
    angle, steps = np.deg2rad(angle_deg), 0.05 * np.arange(1, 11)[:, None]
    sides = np.array([[1.0, 0.0, 0.0], [np.cos(angle), np.sin(angle), 0.0]])
    corner = np.array([2.0, 1.0, -1.0])
    points = np.concatenate([corner + steps[::-1] * sides[0], [corner], corner + steps * sides[1]])
    found = curvatures(points)
    assert found[10] == pytest.approx((15 * 0.05) ** 2 * (2.0 + 2.0 * np.cos(angle)), rel=1e-9)
    # Four steps off the corner the fifth neighbour on one side lies on the other: out of line by one step of each.
    assert found[14] == pytest.approx(0.05**2 * (2.0 + 2.0 * np.cos(angle)), rel=1e-9)
    assert np.nanargmax(found) == 10


def test_a_curvature_is_of_one_ring():
    points = np.linspace([5.0, 0.0, 0.0], [5.0, 39.0, 0.0], 40)
    found = curvatures(points, np.arange(40) // 20)
    np.testing.assert_array_equal(np.isnan(found), ~np.isin(np.arange(40) % 20, np.arange(5, 15)))


def kinds_of(points: FloatArray, rings: NDArray[np.intp] | None = None, above_noise: float = 0.0) -> NDArray[np.int8]:
    """Whether points (N, 3), ring after ring, are edges, planar or neither, by default by the published thresholds."""
    rings = np.zeros(len(points), dtype=np.intp) if rings is None else rings
    kinds = np.full(len(points), 9, dtype=np.int8)
    classify(points, np.linalg.norm(points, axis=1), rings, curvatures(points, rings), above_noise, kinds)
    return kinds


def test_the_corner_of_two_walls_is_one_edge():
    """Walls along the diagonals meet straight ahead at a right angle."""
    azimuth = np.deg2rad(np.arange(-20.0, 26.2, 0.4))
    ranges = 4.0 * np.sin(np.pi / 4) / np.sin(np.pi - np.pi / 4 - np.abs(azimuth))
    kinds = kinds_of(on_sphere(azimuth, np.zeros(len(azimuth)), ranges))
    assert np.flatnonzero(kinds == EDGE).tolist() == [50]
    assert (kinds[5:40] == PLANE).all()
    assert (kinds[61:110] == PLANE).all()


def test_waves_of_a_ring_on_rough_ground_are_no_edges(rng):
    """Relief of 3 cm seen at 10 degrees moves the points of a ring by decimetres: beyond the published threshold."""
    azimuth = np.deg2rad(np.arange(0.0, 360.0, 0.3))
    relief_m = np.convolve(rng.standard_normal(len(azimuth) + 6), np.full(7, 7.0**-0.5), "valid") * 0.03
    ring = on_sphere(azimuth, np.full(len(azimuth), np.deg2rad(-10.0)), 10.0 + relief_m / np.tan(np.deg2rad(10.0)))
    assert np.count_nonzero(kinds_of(ring) == EDGE) > 40
    assert np.count_nonzero(kinds_of(ring, above_noise=20.0) == EDGE) < 5


def test_the_edge_of_a_near_surface_is_an_edge_and_that_of_what_it_hides_is_none():
    """A board at 5 m before a wall at 10 m, in the middle 50 points of a ring."""
    is_near, azimuth = np.abs(np.arange(300) - 149.5) < 25.0, np.deg2rad(np.arange(-30.0, 30.0, 0.2) + 0.1)
    x_m = np.where(is_near, 5.0, 10.0)
    kinds = kinds_of(np.column_stack([x_m, x_m * np.tan(azimuth), np.zeros(300)]))
    near, far = np.flatnonzero(is_near), np.flatnonzero(~is_near)
    assert set(np.flatnonzero(kinds == EDGE)) == {near[0], near[-1]}
    assert (kinds[far[5:-5]] == PLANE).all()
    assert (kinds[near[5:-5]] == PLANE).all()


def test_a_surface_nearly_parallel_to_the_beam_has_no_features():
    """A wall beside the sensor's way: neighbours 0.2 degrees apart are 1.4 % of the range apart at 14.3 degrees."""
    incidence = np.deg2rad(np.arange(60.0, 8.0, -0.2))
    points = on_sphere(incidence, np.zeros(len(incidence)), 1.0 / np.sin(incidence))
    kinds = kinds_of(points)
    assert (kinds[incidence < np.deg2rad(13.9)] == 0).all()
    steep = np.flatnonzero(incidence > np.deg2rad(14.7))
    assert (kinds[steep[5:]] == PLANE).all()


def test_the_end_of_a_wall_seen_at_a_grazing_angle_is_no_edge():
    """The last points are too far apart to be reliable; beyond them, a wall at 40 m."""
    incidence = np.deg2rad(np.arange(60.0, 13.8, -0.2))
    ranges = np.concatenate([1.0 / np.sin(incidence), np.full(50, 40.0)])
    angles = np.concatenate([incidence, incidence[-1] - np.deg2rad(0.2) * np.arange(1, 51)])
    kinds = kinds_of(on_sphere(angles, np.zeros(len(angles)), ranges))
    assert kinds[len(incidence) - 1] == 0
    assert (kinds[len(incidence) - 6 : len(incidence) - 3] == PLANE).all()
    assert not (kinds == EDGE).any()


def test_an_edge_excludes_no_neighbours_across_a_gap():
    """A step of 0.3 m, too small to hide anything: both of its sides are edges."""
    azimuth = np.deg2rad(0.2 * np.arange(100))
    kinds = kinds_of(on_sphere(azimuth, np.zeros(100), np.where(np.arange(100) < 50, 5.0, 5.3)))
    assert np.flatnonzero(kinds == EDGE).tolist() == [49, 50]


def test_edges_are_the_sharpest_points_and_no_neighbours(rng):
    """At most twenty in each sixth of a ring, no two of them closer than six points."""
    rings = np.arange(3).repeat(3000)
    azimuth = np.tile(2.0 * np.pi * np.arange(3000) / 3000, 3)
    ranges = 6.0 + 0.05 * rng.standard_normal(9000)
    ranges[rng.uniform(size=9000) < 0.02] -= 0.27  # less than what may hide something
    points = on_sphere(azimuth, 0.02 * rings, ranges)
    kinds, sharpness = kinds_of(points, rings), curvatures(points, rings)
    for first in range(0, 9000, 500):
        edges = first + np.flatnonzero(kinds[first : first + 500] == EDGE)
        assert len(edges) == 20
        assert sharpness[edges].min() > 0.1
    assert (np.diff(np.flatnonzero(kinds == EDGE)) > 5).all()


def test_the_sharpest_of_neighbours_is_chosen(rng):
    """A sharp point is an edge, or has a sharper edge within five points, or one of the sector before."""
    azimuth = np.deg2rad(np.arange(0.0, 360.0, 0.2))
    points = on_sphere(azimuth, np.zeros(1800), 5.0 + 0.015 * rng.standard_normal(1800))
    kinds, sharpness = kinds_of(points), curvatures(points)
    edges = np.flatnonzero(kinds == EDGE)
    assert len(edges) > 20
    assert (np.diff(edges) > 5).all()
    for i in np.setdiff1d(np.flatnonzero(sharpness > 0.1), edges):
        rivals = edges[np.abs(edges - i) <= 5]
        assert any(sharpness[rival] >= sharpness[i] or rival // 300 < i // 300 for rival in rivals)


def distance_to_edges(room: Any, points: FloatArray) -> FloatArray:
    """Distances (N,) of points (N, 3) of the room's surfaces from the nearest edge: of walls, of pillars, of both."""
    away = [np.abs(np.abs(points) - room.half_size)]
    walls = np.sort(away[0], axis=1)
    distance = np.hypot(walls[:, 0], walls[:, 1])
    for x, y, half in room.pillars:
        sides = np.abs(np.abs(points[:, :2] - [x, y]) - half)
        on_side = np.abs(points[:, :2] - [x, y]).max(axis=1) < half + 0.3
        upright = np.hypot(sides[:, 0], sides[:, 1])
        foot = np.hypot(sides.min(axis=1), away[0][:, 2])
        distance = np.where(on_side, np.minimum(distance, np.minimum(upright, foot)), distance)
    return distance


@pytest.mark.parametrize(("sigma_m", "false_edges"), [(0.0, 0.0005), (0.02, 0.0005)])
def test_edges_of_a_room_are_its_edges(room, drive, rng, sigma_m, false_edges):
    T = drive(np.array([0.5]))[0]
    scan = room.ring_sweep(lambda time: np.broadcast_to(T, (*np.shape(time), 4, 4)), 0.5)
    away = np.linalg.norm(scan.points, axis=1, keepdims=True)
    scan = replace(scan, points=scan.points * (1.0 + sigma_m * rng.standard_normal(away.shape) / away))
    edges, planes = extract_features(scan, 0.5, 100.0, FINE_M)
    in_room = edges.points @ T[:3, :3].T + T[:3, 3]
    off = distance_to_edges(room, in_room) > 0.15
    assert np.count_nonzero(off) < false_edges * len(scan)
    assert np.count_nonzero(~off) > 120
    assert len(planes) > 0.5 * len(scan)


def test_features_are_points_as_measured_with_their_times(ring_scans):
    scan = ring_scans[0]
    features = extract_features(scan, 0.5, 100.0, 0.1)
    times = {tuple(point): time for point, time in zip(scan.points, scan.time_offsets, strict=True)}
    for sweep in features:
        np.testing.assert_array_equal(sweep.times, [times[tuple(point)] for point in sweep.points])
    edges, planes = extract_features(replace(scan, time_offsets=None), 0.5, 100.0, 0.1)
    assert edges.times is None
    np.testing.assert_array_equal(planes.points, features[1].points)


def test_one_feature_a_voxel_is_kept(ring_scans):
    """Voxels of half a cell."""
    features = extract_features(ring_scans[0], 0.5, 100.0, 1.0)
    for sweep in features:
        voxels = np.floor(sweep.points / 0.5)
        assert len(np.unique(voxels, axis=0)) == len(voxels)
    assert sum(map(len, features)) < 0.5 * sum(map(len, extract_features(ring_scans[0], 0.5, 100.0, 0.1)))
