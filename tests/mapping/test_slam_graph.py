"""A walk round a block of corridors, with a drift that is known: loops are closed, and nothing else is."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray, exp, inverse, transform_points
from lidarslam.mapping.config import PoseGraphConfig
from lidarslam.mapping.global_map.georeference import GnssTrack, ProjectedTrack
from lidarslam.mapping.loops.closure import NEAR_SCANS, GivenLoops, LoopClosure, RelativePose
from lidarslam.mapping.pose_graph import slam_graph
from lidarslam.mapping.pose_graph.correction import Corrected
from lidarslam.mapping.pose_graph.keyframe_graph import GraphScan, KeyframeGraph
from lidarslam.mapping.pose_graph.optimizer import Optimised, optimise
from lidarslam.mapping.pose_graph.slam_graph import SlamGraph
from lidarslam.mapping.registration.sampled_scan import sizes_of_cells

from .runs import assert_near

VOXEL_M = 0.1
CELL_M = 0.25
CONFIG = PoseGraphConfig(enabled=True)
# At every 40 cm 0.02 degrees of heading too much. (Of a way that is too long by a part of it, a round does not tell.)
DRIFT = exp([0.0, 0.0, np.deg2rad(0.02), 0.0, 0.0, 0.0])
SIGMA = np.diag(np.array([0.002] * 3 + [0.005] * 3) ** 2)


@dataclass(frozen=True, eq=False)
class Walk:
    """What was seen on a way: true poses (M, 4, 4), what the run made of them, and points (N, 3) of each scan."""

    truth: FloatArray
    estimate: FloatArray
    points: list[FloatArray]

    def scans(self) -> Iterator[GraphScan]:
        """As the pipeline tells them."""
        for i, (T, points) in enumerate(zip(self.estimate, self.points, strict=True)):
            motion = inverse(self.estimate[i - 1]) @ T if i else np.eye(4)
            yield GraphScan(T, points, SIGMA, motion, SIGMA, lost=False, belongs_in_map=True)

    def surfaces(self) -> cKDTree:
        """All points where they truly are."""
        pairs = zip(self.truth, self.points, strict=True)
        return cKDTree(np.concatenate([transform_points(T, points) for T, points in pairs]))

    def errors_m(self, poses: FloatArray) -> FloatArray:
        """(M,) how far poses are from the truth, where both begin alike."""
        T = self.truth[0] @ inverse(poses[0]) @ poses
        return np.asarray(np.linalg.norm(T[:, :3, 3] - self.truth[: len(T), :3, 3], axis=1))


def _block(rng: np.random.Generator) -> FloatArray:
    """Points on walls, floor and furniture of a corridor 4 m wide around a block of 20 x 12 m; no two places alike."""
    faces = []
    for x, y in ((12.0, 8.0), (8.0, 4.0)):
        for sign in (-1.0, 1.0):
            faces += [((sign * x, -y, 0.0), (0.0, 2.0 * y, 2.5)), ((-x, sign * y, 0.0), (2.0 * x, 0.0, 2.5))]
    faces.append(((-12.0, -8.0, 0.0), (24.0, 16.0, 0.0)))
    for _ in range(60):
        along, side = rng.uniform(0.0, 72.0), rng.choice([-1.6, 1.6])
        x, y, _ = _along(along, side)
        size = rng.uniform(0.2, 0.8, 3) * [1.0, 1.0, 2.5]
        faces += [((x, y, 0.0), (size[0], 0.0, size[2])), ((x, y, 0.0), (0.0, size[1], size[2]))]
    clouds = []
    for corner, extent in faces:
        edges = np.sort(np.array(extent))[1:]
        count = int(60.0 * edges[0] * edges[1]) + 5
        clouds.append(np.array(corner) + rng.uniform(0.0, 1.0, (count, 3)) * extent)
    cloud = np.concatenate(clouds)
    inside = (np.abs(cloud[:, 0]) < 7.99) & (np.abs(cloud[:, 1]) < 3.99)
    return np.asarray(cloud[~inside])


def _along(way: float, side: float = 0.0) -> tuple[float, float, float]:
    """x, y and heading on a round of 20 x 12 m."""
    corners = np.array([[-10.0, -6.0], [10.0, -6.0], [10.0, 6.0], [-10.0, 6.0]])
    way %= 64.0
    for i, length in enumerate((20.0, 12.0, 20.0, 12.0)):
        if way < length:
            heading = 0.5 * np.pi * i
            ahead = np.array([np.cos(heading), np.sin(heading)])
            x, y = corners[i] + way * ahead + side * np.array([-ahead[1], ahead[0]])
            return float(x), float(y), heading
        way -= length
    raise AssertionError


def _heading(way: float) -> float:
    """Corners are cut over 2 m, so that the sensor turns as robots do."""
    angles = np.array([_along(w)[2] for w in np.linspace(way - 1.0, way + 1.0, 21)])
    return float(np.angle(np.exp(1j * angles).mean()))


@pytest.fixture(scope="module")
def walk() -> Walk:
    rng = np.random.default_rng(7)
    return _walk(_block(rng), np.arange(0.0, 76.0, 0.4), rng)


@pytest.fixture(scope="module")
def second_walk() -> Walk:
    """Through the same block from elsewhere, in a world of its own, turned by 120 degrees."""
    world = _block(np.random.default_rng(7))
    T_own_block = exp([0.0, 0.0, np.deg2rad(120.0), 5.0, -3.0, 0.5])
    return _walk(world, np.arange(27.0, 57.0, 0.4), np.random.default_rng(8), T_own_block)


def _walk(world: FloatArray, ways: FloatArray, rng: np.random.Generator, T_own_block: FloatArray | None = None) -> Walk:
    truth = np.array([exp([0.0, 0.0, 0.0, *_along(w)[:2], 1.0]) @ exp([0, 0, _heading(w), 0, 0, 0]) for w in ways])
    points = []
    for T in truth:
        local = transform_points(inverse(T), world)
        near = local[np.linalg.norm(local, axis=1) < 7.0]
        points.append(near[rng.random(len(near)) < 0.5])
    estimate = [truth[0] if T_own_block is None else T_own_block @ truth[0]]
    for before, after in pairwise(truth):
        estimate.append(estimate[-1] @ inverse(before) @ after @ DRIFT)
    return Walk(truth, np.array(estimate), points)


def follow(walk: Walk, config: PoseGraphConfig = CONFIG, given: GivenLoops | None = None) -> SlamGraph:
    graph = SlamGraph(config, given=given)
    go_on(graph, walk.scans())
    return graph


def go_on(graph: KeyframeGraph, scans: Iterable[GraphScan]) -> None:
    before = len(graph.scan_poses)
    for i, scan in enumerate(scans):
        graph.add(scan)
        graph.draw(scan.points, scan.T_world_lidar, VOXEL_M)
        assert len(graph.scan_poses) == before + i + 1


def joined(*recordings: list[GraphScan]) -> SlamGraph:
    """A graph of recordings that were tracked each by itself."""
    graph = SlamGraph(CONFIG)
    for scans in recordings:
        tracked = KeyframeGraph(CONFIG.keyframes)
        go_on(tracked, scans)
        tracked.end_recording()
        graph.add_recording(tracked)
        tracked.close()
    return graph


def follow_all(*walks: Walk) -> tuple[SlamGraph, Corrected]:
    """One recording after the other."""
    graph = joined(*(list(walk.scans()) for walk in walks))
    return graph, graph.finish()


@pytest.fixture(scope="module")
def closed(walk: Walk) -> tuple[SlamGraph, Corrected]:
    graph = follow(walk)
    return graph, graph.finish()


def test_a_closed_round_takes_the_drift_away(walk, closed):
    graph, result = closed
    np.testing.assert_array_equal(graph.present().T_world_lidar, result.T_world_lidar)
    before, after = walk.errors_m(walk.estimate), walk.errors_m(result.T_world_lidar)
    assert before.max() > 0.6
    assert np.sqrt(np.mean(after**2)) < 0.2 * np.sqrt(np.mean(before**2))
    assert sum(result.inliers) >= 2


def test_an_interrupted_run_is_placed_by_gnss(walk):
    """The graph was given more scans than the run delivered."""
    graph, stamps = follow(walk), 0.1 * np.arange(len(walk.truth))
    track = GnssTrack(stamps, np.zeros((len(stamps), 3)), np.full(len(stamps), 0.02), np.zeros(3))
    corrected = graph.finish((stamps[:-5], ProjectedTrack(track, walk.truth[:, :3, 3], 1.0)))
    assert corrected is not None
    assert len(corrected.T_world_lidar) == len(stamps)
    assert walk.errors_m(corrected.T_world_lidar).max() < 0.05


def test_a_forbidden_loop_is_not_found(walk, closed):
    graph, free = closed
    scans = [graph.keyframes[key].scan for key in range(len(graph.keyframes))]
    near, far = (8, 170), (8 + NEAR_SCANS + 60, 170)
    found = [(scans[one.first], scans[one.second]) for one in free.closures if one.accepted]
    assert found
    assert all(abs(i - near[0]) <= NEAR_SCANS and abs(j - near[1]) <= NEAR_SCANS for i, j in found)
    result = follow(walk, given=GivenLoops(forbidden=(far, near))).finish()
    assert not result.closures
    np.testing.assert_allclose(result.T_world_lidar, walk.estimate, atol=1e-6)
    barred = GivenLoops(forbidden=((100, 300),)).barred(np.array([49, 50, 150, 151, 250]))
    assert barred.tolist() == [False, True, True, False, False]


@pytest.mark.long
def test_a_given_loop_is_closed_from_a_wrong_estimate(walk):
    """No loop is tried by itself; the estimate is off by more than a room, without a word of it."""
    T_off, lost = exp([0.0, 0.0, 1.2, 6.0, -4.0, 0.5]), 140
    estimate = np.array([*walk.estimate[:lost], *(walk.estimate[0] @ T_off @ walk.estimate[lost:])])
    wrong = Walk(walk.truth, estimate, walk.points)
    given = GivenLoops(closed=((12, 172), (25, 80), (150, 151)), forbidden=((12, 172),))
    config = CONFIG.model_copy(update={"loops": CONFIG.loops.model_copy(update={"min_way_m": 1000.0})})
    graph = follow(wrong, config, given)
    result = graph.finish()
    first, second = sorted(result.closures, key=lambda one: one.given or (0, 0))
    assert (first.given, first.accepted, second.given, second.accepted) == ((12, 172), True, (25, 80), False)
    assert second.reason
    assert result.inliers.count(True) == 1
    keys = [graph.keyframes[key].scan for key in (first.first, first.second)]
    assert [scan - asked for scan, asked in zip(keys, (12, 172), strict=True)] == pytest.approx([2, 2], abs=2.5)
    T_true = inverse(walk.truth[keys[0]]) @ walk.truth[keys[1]]
    assert np.linalg.norm((inverse(first.T_first_second) @ T_true)[:3, 3]) < 0.05
    assert walk.errors_m(result.T_world_lidar)[keys[1]] < 0.1 < walk.errors_m(estimate)[keys[1]]


def test_every_loop_that_is_inlier_is_one_and_an_edge_beside_those_of_trajectory_and_odometry(walk, closed):
    _, result = closed
    for closure, inlier in zip(result.closures, result.inliers, strict=True):
        first, second = (walk.truth[result.keyframe_scans[k]] for k in (closure.first, closure.second))
        if inlier:
            assert closure.accepted
            assert_near(closure.T_first_second, inverse(first) @ second, 0.1, 1.0)
    keyframes, loops = len(result.keyframe_scans), sum(isinstance(edge, LoopClosure) for edge in result.edges)
    assert loops == sum(result.inliers)
    assert len(result.edges) - loops == 2 * (keyframes - 1)
    assert 20 < keyframes < 120


def test_the_map_is_drawn_where_the_scans_have_gone(walk, closed):
    graph, result = closed
    true = walk.surfaces()
    drawn = true.query(graph.draw_map(result, VOXEL_M).points())[0]
    uncorrected = replace(result, keyframe_poses=walk.estimate[result.keyframe_scans])
    off = true.query(graph.draw_map(uncorrected, VOXEL_M).points())[0]
    assert np.percentile(drawn, 90.0) < 0.5 * np.percentile(off, 90.0)


@pytest.mark.long
def test_the_local_map_is_drawn_anew_where_the_second_round_is(walk):
    """Surfaces of the first round lie where the truth has them relative to the sensor, which has drifted away."""
    graph, redrawn = SlamGraph(CONFIG, local_radius_m=8.0), []
    for i, scan in enumerate(walk.scans()):
        graph.add(scan)
        local_map = graph.redrawn_local_map(sizes_of_cells(CELL_M))
        if local_map is not None:
            redrawn.append((i, local_map))
        graph.draw(scan.points, scan.T_world_lidar, VOXEL_M)
    graph.close()
    assert 1 <= len(redrawn) <= 3
    first_round = np.concatenate([transform_points(walk.truth[i], walk.points[i]) for i in range(8)])
    for i, local_map in redrawn:
        due = transform_points(walk.estimate[i] @ inverse(walk.truth[i]), first_round)
        is_near = np.linalg.norm(due - walk.estimate[i][:3, 3], axis=1) < 5.0
        assert np.median(np.linalg.norm(due - first_round, axis=1)[is_near]) > CELL_M, "the drift is visible"
        due = due[is_near]
        matches = local_map.match(due, walk.estimate[i])
        assert len(np.unique(matches.index)) > 0.6 * len(due)  # walls of the block are transparent
        assert np.median(np.abs(matches.residuals(due[matches.index]))) < 0.02
        distances, _ = cKDTree(local_map.means()).query(due)
        assert np.percentile(distances, 95) < 2.0 * CELL_M


def test_a_local_map_that_is_right_is_left_alone(walk):
    """Loops are closed, but the poses were right, and stay so; all is within the radius."""
    graph = SlamGraph(CONFIG, local_radius_m=60.0)
    right = replace(walk, estimate=walk.truth)
    for scan in right.scans():
        graph.add(scan)
        assert graph.redrawn_local_map(sizes_of_cells(CELL_M)) is None
        graph.draw(scan.points, scan.T_world_lidar, VOXEL_M)
    result = graph.finish()
    assert sum(result.inliers) >= 2
    assert walk.errors_m(result.T_world_lidar).max() < 0.01
    graph.close()


def test_where_tracking_was_lost_the_edge_is_weak_and_no_keyframe_is_made(walk):
    scans = list(walk.scans())[:60]
    for i in range(20, 28):
        scans[i] = replace(scans[i], lost=True, belongs_in_map=False, covariance=None, T_prev_curr=None)
    go_on(graph := SlamGraph(CONFIG), scans)
    result = graph.finish()
    assert not set(range(20, 28)) & set(result.keyframe_scans.tolist())
    after = np.searchsorted(result.keyframe_scans, 20)
    (weak,) = (edge for edge in result.edges if (edge.first, edge.second) == (after - 1, after))
    assert weak.covariance[3, 3] >= 1.0
    assert np.sqrt(weak.covariance[2, 2]) >= np.deg2rad(20.0)


def test_a_run_without_a_scan_has_nothing_to_correct():
    graph = SlamGraph(CONFIG)
    assert graph.present() is None
    assert graph.finish() is None
    graph.draw(np.zeros((3, 3)), np.eye(4), VOXEL_M)  # nothing to draw into, and no harm done
    graph.close()


def test_a_recording_that_is_added_whole_has_the_result_of_one_that_is_followed(walk, closed):
    _, expected = closed
    _, result = follow_all(walk)
    np.testing.assert_array_equal(result.T_world_lidar, expected.T_world_lidar)
    assert result.inliers == expected.inliers
    assert len(result.edges) == len(expected.edges)
    assert len(result.closures) == len(expected.closures) > 0


@pytest.fixture(scope="module")
def two(walk: Walk, second_walk: Walk) -> tuple[SlamGraph, Corrected]:
    return follow_all(walk, second_walk)


@pytest.mark.long
def test_a_second_recording_finds_itself_in_the_first(walk, second_walk, two):
    graph, result = two
    count = len(walk.truth)
    assert result.first_scans.tolist() == [0, count]
    assert result.frames.tolist() == [0, 0]
    # Both in the frame of the first, which begins at its true pose.
    wrong = result.T_world_lidar[:, :3, 3] - np.concatenate([walk.truth, second_walk.truth])[:, :3, 3]
    wrong_m = np.linalg.norm(wrong, axis=1)
    assert wrong_m[count:].max() < 0.15
    assert np.median(np.linalg.norm(second_walk.estimate[:, :3, 3] - second_walk.truth[:, :3, 3], axis=1)) > 5.0
    # Where both were, they agree better than either with the truth.
    here, there = result.T_world_lidar[count:, :3, 3], second_walk.truth[:, :3, 3]
    nearest = cKDTree(walk.truth[:, :3, 3]).query(there)[1]
    between = (here - result.T_world_lidar[nearest, :3, 3]) - (there - walk.truth[nearest, :3, 3])
    assert np.median(np.linalg.norm(between, axis=1)) < 0.05
    # No edge but loops leads from one to the other.
    recordings = result.keyframe_recordings
    across = [edge for edge in result.edges if recordings[edge.first] != recordings[edge.second]]
    assert len(across) >= 3
    assert all(isinstance(edge, LoopClosure) for edge in across)
    drawn = graph.draw_map(result, VOXEL_M, [1]).points()
    assert np.percentile(walk.surfaces().query(drawn)[0], 90.0) < 0.2
    assert 0 < len(drawn) < len(graph.draw_map(result, VOXEL_M).points())


@pytest.mark.long
def test_what_joined_two_recordings_and_is_not_inlier_in_the_end_leaves_no_trace(walk, second_walk, two, monkeypatch):
    graph, joined = two

    def reject_all(poses: FloatArray, edges: list[RelativePose], loops: list[RelativePose], _: object) -> Optimised:
        return replace(optimise(poses, edges, loops), inliers=np.zeros(len(loops), dtype=np.bool_))

    monkeypatch.setattr(slam_graph, "optimise", reject_all)
    result = graph.finish()
    assert result.frames.tolist() == [0, 1]
    count = len(walk.truth)
    first = result.keyframe_scans[result.keyframe_recordings == 1][0]
    np.testing.assert_allclose(result.T_world_lidar[first], second_walk.estimate[first - count], atol=1e-9)
    # In one piece: nothing within the recording moves.
    steps, as_joined = (inverse(T[count:-1]) @ T[count + 1 :] for T in (result.T_world_lidar, joined.T_world_lidar))
    np.testing.assert_allclose(steps, as_joined, atol=1e-3)
    np.testing.assert_allclose(result.T_world_lidar[:count], joined.T_world_lidar[:count], atol=1e-3)


def test_recordings_without_a_keyframe_are_in_frames_of_their_own(walk):
    """One without a scan, one whose scans are all lost; those around them are corrected as ever."""
    scans, far = list(walk.scans()), exp([0.0, 0.0, 0.0, 0.0, 0.0, 100.0])
    lost = [replace(s, T_world_lidar=far @ s.T_world_lidar, belongs_in_map=False, lost=True) for s in scans[:5]]
    graph = joined(scans[:30], [], lost, scans[29:39])
    result = graph.finish()
    assert result.first_scans.tolist() == [0, 30, 30, 35]
    assert result.frames[:3].tolist() == [0, 1, 2]
    assert sorted(set(result.keyframe_recordings.tolist())) == [0, 3]
    np.testing.assert_allclose(result.T_world_lidar[30:35], far @ walk.estimate[:5], atol=1e-9)
    assert graph.draw_map(result, VOXEL_M).points()[:, 2].max() < 10.0  # what is lost is drawn into no submap
    assert 35 in result.keyframe_scans  # a recording begins with one, wherever the last keyframe before it was
    firsts = [edge.first for edge in result.edges if not isinstance(edge, LoopClosure)]
    assert int(np.flatnonzero(result.keyframe_recordings == 0)[-1]) not in firsts
    graph.close()
