"""Submaps on disk, a local map drawn anew from them, where they lay in it at a scan, and closures within it."""

from collections.abc import Iterable

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse
from lidarslam.mapping.global_map.global_map import VoxelMeans
from lidarslam.mapping.global_map.voxels import Layout, Rows
from lidarslam.mapping.loops.closure import LoopClosure
from lidarslam.mapping.pose_graph.keyframe_graph import Keyframe
from lidarslam.mapping.pose_graph.submap_placement import SCANS_LATER, Drawn, SubmapPlacement, draw_local_map
from lidarslam.mapping.registration.sampled_scan import sizes_of_cells
from lidarslam.mapping.surfels.surfel_map import SurfelMap

from .shapes import insert

CELL_M, RADIUS_M, SPACING_M = 0.3, 10.0, 3.0
CELLS_M = sizes_of_cells(CELL_M)
WALL_M, OFF_M = 6.1, 0.1


def means_of_wall(rng: np.random.Generator, x_m: float, half_size_m: float, spacing_m: float = 0.2) -> Rows:
    """Means of a wall across the x axis, at that distance, in the keyframe's frame."""
    along = np.arange(-half_size_m, half_size_m, spacing_m)
    points = np.stack(np.meshgrid([x_m], along, along), axis=-1).reshape(-1, 3)
    points = points + rng.normal(0.0, 0.003, points.shape)
    views = -points / np.linalg.norm(points, axis=1, keepdims=True)
    return np.column_stack([points, views, np.ones(len(points))]).astype(np.float32)


def at(x_m: float) -> FloatArray:
    return exp([0.0, 0.0, 0.0, x_m, 0.0, 0.0])


def off_wall_m(local_map: SurfelMap, half_size_m: float) -> float:
    """By how much the surface that points of the wall correspond to lies behind it, the median."""
    y, z = np.random.default_rng(5).uniform(-half_size_m, half_size_m, (2, 500))
    wall = np.column_stack([np.full(500, WALL_M), y, z])
    matches = local_map.match(wall, np.eye(4))
    assert len(matches.index) > 400
    return float(np.median(np.abs(matches.residuals(wall[matches.index]))))


def test_scans_that_follow_do_not_shift_what_was_drawn(rng):
    """They are registered to it; their own errors would repeat, and carry the surfaces along."""
    submaps = [(np.eye(4), means_of_wall(rng, WALL_M, 2.5)) for _ in range(2)]
    drawn = draw_local_map(submaps, CELLS_M, RADIUS_M)
    assert off_wall_m(drawn, 1.5) < 0.005
    for _ in range(20):
        insert(drawn, means_of_wall(rng, WALL_M + OFF_M, 2.5)[:, :3].astype(np.float64))
    assert off_wall_m(drawn, 1.5) < 0.02


def laid(
    submaps: dict[int, Rows], poses: Iterable[FloatArray], targets: FloatArray
) -> tuple[SubmapPlacement, SurfelMap]:
    """After the poses as registered, the map drawn with others, before scan 40."""
    laid = SubmapPlacement(RADIUS_M)
    for pose in poses:
        laid.follow(pose)
    members = np.ones(len(targets), dtype=np.bool_)
    drawn = laid.redrawn(targets, members, CELLS_M, lambda key: VoxelMeans(submaps[key], Layout()), scan=40)
    return laid, drawn


def test_a_drawn_map_holds_all_that_its_submaps_reach(rng):
    """Else the latest scans alone would make its border, which most of a scan may lie beyond."""
    far_m = 2.5 * RADIUS_M
    submaps = {key: means_of_wall(rng, far_m, 4.0) for key in range(2)}
    _, drawn = laid(submaps, [at(0.0), at(1.0)], np.array([at(0.0), at(1.0)]) @ exp([0, 0, 0, 0.0, 1.0, 0.0]))
    for x_m in (0.0, 0.3 * RADIUS_M):  # what is too far is dropped when the sensor has moved
        drawn.insert(np.array([[x_m + 3.0, 0.0, 0.0]]), np.zeros(1), np.array([x_m, 0.0, 0.0]))
    wall = np.column_stack([np.full(50, far_m), *rng.uniform(-2.0, 4.0, (2, 50))])
    assert len(drawn.match(wall, np.eye(4)).index) > 40


def test_where_a_submap_lay_when_a_scan_was_registered(rng):
    """Out and back: keyframe 9 is beside keyframe 0, and has drifted off; keyframes 4 and 5 are beyond the radius."""
    ways = [SPACING_M * min(key, 9 - key) for key in range(10)]
    poses = np.array([at(way + (0.5 if key > 4 else 0.0)) for key, way in enumerate(ways)])
    targets = np.array([at(way + 0.5) for way in ways])
    submaps = {key: means_of_wall(rng, WALL_M, 2.5) for key in range(10)}
    placement = laid(submaps, poses, targets)[0]
    exchanged = 40 + SCANS_LATER
    before = placement.place(0, 0, poses[0], exchanged - 1)
    after = placement.place(0, 0, poses[0], exchanged)
    assert (before[1], after[1]) == (0, exchanged)
    np.testing.assert_array_equal(before[0], poses[0])
    np.testing.assert_allclose(after[0], at(0.5), atol=1e-12)
    assert placement.place(4, 16, poses[4], exchanged) is None, "beyond the radius"
    later = placement.place(10, 45, at(-1.0), exchanged + 3)
    assert later[1] == 45, "of a keyframe since then, its own pose"
    assert placement.is_exchanged(exchanged - 1, exchanged)
    assert not placement.is_exchanged(exchanged, exchanged + 5)


REGISTERED = np.diag([1e-3] * 3 + [5e-3] * 3) ** 2


@pytest.fixture
def round_trip() -> FloatArray:
    """Poses (101, 4, 4) once round a circle of 40 m across, and a little farther."""
    turn = np.array([0.0, 0.0, 2.0 * np.pi / 100.0, 2.0 * np.pi * 20.0 / 100.0, 0.0, 0.0])
    poses = [exp([0.1, 0.0, 0.3, 5.0, -2.0, 1.0])]
    for _ in range(100):
        poses.append(poses[-1] @ exp(1.002 * turn))
    return np.array(poses)


def closure(way: FloatArray, off: FloatArray) -> LoopClosure:
    """Of its first and last pose, off by (6,) from what the way says."""
    T_first_second = inverse(way[0]) @ way[-1] @ exp(off)
    return LoopClosure(0, 25, T_first_second, 1e-4 * np.eye(6), 0.9, 0.01, 0.9, False, 3, "")


NEAR = np.array([0.0, 0.002, 0.0, 0.012, -0.01, 0.0])


def as_registered(
    measured: LoopClosure, way: FloatArray, radius_m: float, first: FloatArray | None = REGISTERED,
    drawn: tuple[Drawn, ...] = (),
) -> LoopClosure:  # fmt: skip
    """The closure of the first and last scan, in a local map of that radius."""
    placement = SubmapPlacement(radius_m)
    placement._drawn = [*drawn]
    ends = Keyframe(0, 0, 0.0, first), Keyframe(len(way) - 1, 0, 1.0, REGISTERED)
    return placement.as_registered(measured, *ends, list(way))


def test_where_the_map_held_the_place_the_trajectory_measures_the_closure_wherever_the_submap_was_laid(round_trip):
    """In the end the local map was drawn anew before the last ten scans, which are registered to its surfaces."""
    found = as_registered(closure(round_trip, NEAR), round_trip, 100.0)
    np.testing.assert_allclose(found.T_first_second, inverse(round_trip[0]) @ round_trip[-1], atol=1e-12)
    assert found.accepted
    assert np.linalg.eigvalsh(found.covariance - REGISTERED).min() > 0.0, "both registrations err"
    T_odom_first = round_trip[0] @ exp(0.5 * NEAR)
    drawn = Drawn(len(round_trip) - 10, np.array([0]), 1, T_odom_first[None])
    found = as_registered(closure(round_trip, NEAR), round_trip, 30.0, drawn=(drawn,))
    np.testing.assert_allclose(found.T_first_second, inverse(T_odom_first) @ round_trip[-1], atol=1e-12)


@pytest.mark.parametrize(("radius_m", "first", "off"), [
    (50.0, REGISTERED, NEAR), (0.0, REGISTERED, NEAR), (100.0, None, NEAR),
    (100.0, REGISTERED, np.array([0.0, 0.0, 0.0, 0.4, 0.0, 0.0])),
], ids=["the way left the map", "without a map", "not registered", "drifted off its own map"])  # fmt: skip
def test_elsewhere_the_closure_counts(round_trip, radius_m, first, off):
    measured = closure(round_trip, off)
    assert as_registered(measured, round_trip, radius_m, first) is measured
