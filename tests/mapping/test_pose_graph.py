"""Keyframes, the edges between them, pose graphs whose optimal poses are known, and trajectories corrected by them."""

from collections.abc import Sequence

import gtsam
import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, adjoint, exp, inverse, log
from lidarslam.core.trajectory import chain
from lidarslam.mapping.config import KeyframeConfig
from lidarslam.mapping.loops.closure import LoopClosure, RelativePose
from lidarslam.mapping.pose_graph import keyframe_graph
from lidarslam.mapping.pose_graph.correction import corrected, format_g2o
from lidarslam.mapping.pose_graph.keyframe_graph import (
    Attitude,
    GraphScan,
    KeyframeSelector,
    MotionSinceKeyframe,
    drift_covariance,
    first_connected,
    trajectory_edges,
)
from lidarslam.mapping.pose_graph.optimizer import _LEAST, RelaxSchedule, bounded, optimise, relax

from .runs import assert_near

LOOSE = np.diag([0.02, 0.01, 0.03, 0.3, 0.2, 0.1]) ** 2
TIGHT = np.diag([0.002, 0.001, 0.003, 0.03, 0.02, 0.01]) ** 2
LAP = 40
FALSE = ((5, 45), (17, 62), (30, 74), (8, 50), (22, 71), (11, 66))


def laps(count: int) -> FloatArray:
    """Keyframes 1 m apart round a square of 10 m, as often as needed."""
    steps = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0], (count - 1, 1))
    steps[9::10] = [0.0, 0.0, np.pi / 2, np.pi / 4, 0.0, 0.0]  # turn on a quarter of a circle
    return chain(np.eye(4), exp(steps))


def edge(poses: FloatArray, first: int, second: int, covariance: FloatArray = TIGHT) -> RelativePose:
    """What an errorless sensor measures."""
    return RelativePose(first, second, inverse(poses[first]) @ poses[second], covariance)


def chained(poses: FloatArray, covariance: FloatArray = TIGHT) -> list[RelativePose]:
    return [edge(poses, key, key + 1, covariance) for key in range(len(poses) - 1)]


def with_errors(edges: Sequence[RelativePose], rng: np.random.Generator) -> list[RelativePose]:
    """Wrong by as much as their covariances say."""
    roots = [np.linalg.cholesky(e.covariance) for e in edges]
    return [
        RelativePose(e.first, e.second, e.T_first_second @ exp(root @ rng.normal(size=6)), e.covariance)
        for e, root in zip(edges, roots, strict=True)
    ]


def false_edges(poses: FloatArray, pairs: Sequence[tuple[int, int]], rng: np.random.Generator) -> list[RelativePose]:
    """Far from the truth, each in its own way."""
    wrong = exp(rng.normal(size=(len(pairs), 6)) * [0.1, 0.1, 1.0, 8.0, 8.0, 1.0])
    return [RelativePose(a, b, inverse(poses[a]) @ poses[b] @ T, TIGHT) for (a, b), T in zip(pairs, wrong, strict=True)]


def drifted(edges: Sequence[RelativePose], count: int) -> FloatArray:
    """Poses from the chain alone."""
    steps = {e.first: e.T_first_second for e in edges if e.second == e.first + 1}
    return chain(np.eye(4), np.stack([steps[key] for key in range(count - 1)]))


def test_a_drifted_square_with_one_exact_closure_becomes_exact():
    """The chain is exact as well; only the initial poses have drifted."""
    truth = laps(LAP + 1)
    bend = exp(np.linspace(0.0, 1.0, LAP + 1)[:, None] * [0.05, -0.03, 0.3, 2.0, -1.0, 0.5])
    optimised = optimise(truth @ bend, chained(truth), [edge(truth, 0, LAP)])
    assert_near(optimised.poses, truth, 1e-6)
    assert optimised.inliers.tolist() == [True]


@pytest.mark.parametrize(("true", "false"), [(0, 1), (3, 1), (10, 6)])
def test_false_loops_are_rejected_and_change_nothing(true, false, rng):
    truth = laps(2 * LAP)
    edges = with_errors(chained(truth), rng)
    start = drifted(edges, len(truth))
    keys = np.linspace(0, LAP - 1, true).astype(int).tolist()
    loops = with_errors([edge(truth, key, key + LAP) for key in keys], rng)
    wrong = false_edges(truth, FALSE[:false], rng)
    expected = optimise(start, edges, loops)
    found = optimise(start, edges, wrong + loops)
    assert found.inliers.tolist() == [False] * false + [True] * true
    assert_near(found.poses, expected.poses, 1e-6)


def test_edges_are_weighed_by_their_covariances():
    """Two measurements of one motion: the estimate is their mean, weighted by information."""
    far, near = exp([0, 0, 0, 2.0, 0, 0]), exp([0, 0, 0, 1.0, 0, 0])
    edges = [RelativePose(0, 1, far, LOOSE), RelativePose(0, 1, near, LOOSE / 9.0)]
    optimised = optimise(np.stack([np.eye(4)] * 2), edges, [])
    np.testing.assert_allclose(optimised.poses[1], exp([0, 0, 0, 1.1, 0, 0]), atol=1e-8)
    assert len(optimised.inliers) == 0


def test_the_order_of_a_covariance_is_rotation_first():
    """Of two chains around a square of four poses, that bends which may: in translation along y, not in rotation."""
    bendy = np.diag([1e-3, 1e-3, 1e-3, 1e-3, 1.0, 1e-3]) ** 2  # precise but for translation along y
    stiff = np.diag([1e-3] * 6) ** 2
    edges = [RelativePose(0, 1, np.eye(4), bendy), RelativePose(1, 2, np.eye(4), stiff)]
    edges.append(RelativePose(0, 2, exp([0, 0, 0, 0, 0.5, 0]), stiff))
    poses = optimise(np.stack([np.eye(4)] * 3), edges, []).poses
    assert_near(poses, exp(np.array([[0.0] * 6, [0, 0, 0, 0, 0.5, 0], [0, 0, 0, 0, 0.5, 0]])), 1e-5)


def test_relaxed_poses_close_loops_and_bear_false_ones(rng):
    truth = laps(2 * LAP)
    edges = with_errors(chained(truth, LOOSE), rng)
    poses = drifted(edges, len(truth))
    assert np.linalg.norm(poses[60, :3, 3] - truth[60, :3, 3]) > 1.0
    true = [edge(truth, 0, key) for key in range(4, 80, 4)]
    loops = true[:12] + false_edges(truth, FALSE[:3], rng) + true[12:]
    for count in range(1, len(loops) + 1):
        poses = relax(poses, edges, loops[:count])
    assert_near(poses[4:80:4], truth[4:80:4], 0.1)


def apart(truth: FloatArray, T_world_world: FloatArray) -> tuple[FloatArray, list[RelativePose]]:
    """Two components, the second lap of the truth in a world of its own."""
    edges = [e for e in chained(truth) if e.second != LAP]
    return np.concatenate([truth[:LAP], T_world_world @ truth[LAP:]]), edges


def test_components_that_nothing_joins_stay_where_they_are():
    poses, edges = apart(laps(2 * LAP), exp([0.1, 0.2, 3.0, 500.0, 300.0, 20.0]))
    assert_near(optimise(poses, edges, []).poses, poses, 1e-6)
    assert_near(relax(poses, edges, []), poses, 1e-6)


@pytest.mark.parametrize(("true", "false"), [(3, 0), (2, 1), (3, 6)])
def test_loops_bring_two_components_together_and_false_ones_are_rejected(true, false, rng):
    """The second is begun in a world of its own, turned half round and far away."""
    truth = laps(2 * LAP)
    poses, edges = apart(truth, exp([0.0, 0.1, 2.5, 80.0, -50.0, 3.0]))
    loops = [edge(truth, key, key + LAP) for key in (3, 13, 33)[:true]]
    assert_near(relax(poses, edges, loops), truth, 1e-4)
    found = optimise(poses, edges, loops + false_edges(truth, FALSE[:false], rng))
    assert found.inliers.tolist() == [True] * true + [False] * false
    assert_near(found.poses, truth, 1e-5)


def test_of_two_loops_that_contradict_one_another_at_most_one_is_an_inlier(rng):
    truth = laps(2 * LAP)
    poses, edges = apart(truth, np.eye(4))
    found = optimise(poses, edges, false_edges(truth, ((3, 43), (13, 63)), rng))
    assert found.inliers.sum() <= 1
    assert np.isfinite(found.poses).all()


@pytest.mark.parametrize("covariance", [
    np.zeros((6, 6)), np.diag([1e-6, 1e-6, 1e-6, 1e-4, 1e-4, 1e8]), np.diag([-1e-6, 1e-6, 1e-6, 1e-4, 1e-4, 1e-4]),
    np.eye(6) + np.triu(np.ones((6, 6)), 1) * 1e-3,
])  # fmt: skip
def test_bad_covariances_are_bounded_and_do_no_harm(covariance):
    kept = bounded(covariance)
    np.testing.assert_array_equal(kept, kept.T)
    assert np.sqrt(np.linalg.eigvalsh(kept))[0] > 0.9 * _LEAST.min()
    truth = laps(10)
    start = truth @ exp([0, 0, 0.01, 0.1, 0, 0])
    poses = optimise(start, [*chained(truth, covariance), *chained(truth)], []).poses
    assert_near(poses, poses[0] @ inverse(truth[0]) @ truth, 1e-5)


@pytest.mark.parametrize(
    "variances", [[1e-6, 1e-6, 1e-6, 1e8, 1e-4, 1e-4], [1e8, 1e8, 1e8, 1e-8, 1e-8, 1e-8], [0.0] * 6]
)
def test_a_chain_that_is_loose_in_some_directions_can_be_solved(variances):
    truth = laps(2 * LAP)
    edges, loops = chained(truth, np.diag(variances)), [edge(truth, 0, 2 * LAP - 1)]
    assert_near(relax(truth, edges, loops), truth, 1e-6)
    assert_near(optimise(truth, edges, loops).poses, truth, 1e-6)


def test_a_good_covariance_is_kept(rng):
    A = rng.normal(size=(6, 6)) * 0.1
    np.testing.assert_allclose(bounded(A @ A.T), A @ A.T, rtol=1e-12)
    np.testing.assert_allclose(bounded(np.zeros((6, 6))), np.diag(_LEAST**2), rtol=1e-12)


def test_a_component_is_named_by_its_first_node():
    assert first_connected(8, [(6, 7), (4, 5), (5, 7), (1, 2)]).tolist() == [0, 1, 1, 3, 4, 4, 4, 4]
    assert first_connected(2, []).tolist() == [0, 1]


def test_gravity_holds_roll_and_pitch_where_the_edges_drift():
    """On a long flat drive: edges that pitch up a little each end far above the ground, attitudes keep them on it."""
    truth = chain(np.eye(4), exp(np.tile([0.0, 0.0, 0.002, 1.0, 0.0, 0.0], (300, 1))))
    up = np.array([0.0, 0.0, 1.0])
    bend = exp(np.array([0.0, np.deg2rad(-0.02), 0.0, 0.0, 0.0, 0.0]))
    covariance = np.diag([np.deg2rad(0.05)] * 3 + [0.01] * 3) ** 2
    edges = [RelativePose(k, k + 1, one.T_first_second @ bend, covariance) for k, one in enumerate(chained(truth))]
    attitudes = [Attitude(key, truth[key, :3, :3].T @ up, up, np.deg2rad(0.3)) for key in range(0, len(truth), 2)]
    alone = optimise(drifted(edges, len(truth)), edges, []).poses
    held = optimise(drifted(edges, len(truth)), edges, [], attitudes).poses
    tilts = [np.rad2deg(np.arccos(np.clip(poses[:, 2, 2], -1.0, 1.0))).max() for poses in (alone, held)]
    assert tilts[0] > 5.0
    assert tilts[1] < 0.3
    heights = [float(np.abs(poses[:, 2, 3] - truth[:, 2, 3]).max()) for poses in (alone, held)]
    assert heights[0] > 10.0
    assert heights[1] < 0.05 * heights[0]


def test_an_attitude_leaves_the_heading_alone():
    truth = np.stack([np.eye(4), exp([0.0, 0.0, 2.0, 1.0, 0.0, 0.0])])
    edges, up = chained(truth), np.array([0.0, 0.0, 1.0])
    assert_near(optimise(truth, edges, [], [Attitude(1, up, up, 1e-3)]).poses, truth, 1e-6)


def closure(second: int, off_m: float = 1.0, reason: str = "") -> LoopClosure:
    T = exp([0.0, 0.0, 0.0, off_m, 0.0, 0.0])
    return LoopClosure(0, second, T, 1e-4 * np.eye(6), 0.9, 0.01, 0.9, False, 2, reason)


def dues(keyframes: range, off_m: float = 1.0, reason: str = "") -> list[int]:
    """The numbers of keyframes at which it is due, with a closure at each."""
    schedule = RelaxSchedule()
    return [n for n in keyframes if schedule.is_due([closure(n - 1, off_m, reason)], [np.eye(4)] * n)]


def test_a_small_graph_is_optimised_at_every_closure_that_contradicts_it():
    assert dues(range(50, 100)) == list(range(50, 100))
    assert dues(range(50, 100), off_m=0.005) == []
    assert dues(range(50, 100), reason="overlap") == []


def test_the_wait_grows_with_the_graph():
    found = dues(range(4000, 4200))
    assert found[0] == 4000
    assert set(np.diff(found).tolist()) <= {41, 42}


def test_a_closure_that_had_to_wait_is_not_forgotten():
    schedule, poses = RelaxSchedule(), [np.eye(4)] * 4100
    assert schedule.is_due([closure(3999)], poses[:4000])
    assert not schedule.is_due([closure(4000)], poses[:4001])
    due = [n for n in range(4002, 4100) if schedule.is_due([], poses[:n])]
    assert due == [4041]


@pytest.fixture
def hall(rng: np.random.Generator) -> FloatArray:
    """Points on a circle of walls 8 m away."""
    angle, height = rng.uniform(-np.pi, np.pi, 4000), rng.uniform(-1.0, 2.0, 4000)
    return np.stack([8.0 * np.cos(angle), 8.0 * np.sin(angle), height], axis=1)


def selector(points: FloatArray, **options: float | None) -> KeyframeSelector:
    chosen = KeyframeSelector(KeyframeConfig.model_validate(options))
    assert chosen.is_due(np.eye(4), points)
    chosen.take(np.eye(4), points)
    return chosen


def moved(x: float = 0.0, turn_deg: float = 0.0) -> FloatArray:
    return exp([0.0, 0.0, np.deg2rad(turn_deg), x, 0.0, 0.0])


@pytest.mark.parametrize(("scale", "given_m", "distance_m"), [
    (1.0, None, 2.05), (4.0, None, 4.0), (0.1, None, 0.5), (1.0, 3.0, 3.0),
])  # fmt: skip
def test_the_way_to_the_next_follows_the_scene_or_is_the_given_one(hall, monkeypatch, scale, given_m, distance_m):
    """A quarter of 8 m; in a hall four times as large it would be 4 m at most, in a shaft 0.5 m at least."""
    monkeypatch.setattr(keyframe_graph, "_LEAST_OVERLAP", 0.0)
    chosen = selector(scale * hall, distance_m=given_m)
    assert not chosen.is_due(moved(0.97 * distance_m), scale * hall)
    assert chosen.is_due(moved(1.03 * distance_m), scale * hall)


def test_a_turn_on_the_spot_makes_a_keyframe(hall):
    chosen = selector(hall, turn_deg=30.0)
    assert not chosen.is_due(moved(turn_deg=29.0), hall)
    assert chosen.is_due(moved(turn_deg=-31.0), hall)


@pytest.mark.parametrize(("least_overlap", "is_due"), [(0.6, True), (0.4, False)])
def test_a_scan_that_sees_other_things_is_due(hall, monkeypatch, least_overlap, is_due):
    """Half of it elsewhere: through a door, say."""
    monkeypatch.setattr(keyframe_graph, "_LEAST_OVERLAP", least_overlap)
    beyond = hall + np.where(hall[:, :1] > 0.0, [[10.0, 0.0, 0.0]], 0.0)
    assert not selector(hall).is_due(moved(0.1), hall)
    assert selector(hall).is_due(moved(0.1), beyond) == is_due


def test_noise_is_no_new_sight(hall, rng, monkeypatch):
    monkeypatch.setattr(keyframe_graph, "_LEAST_OVERLAP", 0.95)
    chosen = selector(hall)
    assert not chosen.is_due(np.eye(4), hall + rng.normal(0.0, 0.05, hall.shape))


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


def test_without_a_map_the_odometry_counts_once():
    [edge] = trajectory_edges(1, STEP, motion_of(scan(STEP)), None, None)
    np.testing.assert_array_equal(edge.covariance, drift_covariance(1.5, registered=False))


def test_between_two_maps_the_edge_is_that_of_an_odometry():
    """One of them was drawn anew, and surfaces lie elsewhere in it."""
    [edge] = trajectory_edges(1, STEP, motion_of(scan(None)), SIGMA, SIGMA, one_map=False)
    apart = edge.covariance - drift_covariance(1.5, registered=False)
    assert np.linalg.eigvalsh(apart).min() > 0.0
    assert len(trajectory_edges(1, STEP, motion_of(scan(STEP)), SIGMA, SIGMA, one_map=False)) == 2


FAR = exp([0.2, -0.3, 2.0, 5e5, -3e5, 100.0])


@pytest.fixture
def trajectory(rng: np.random.Generator) -> FloatArray:
    """Forty scans along a winding way."""
    steps = rng.normal(size=(39, 6)) * [0.02, 0.02, 0.2, 0.1, 0.1, 0.05] + [0.0, 0.0, 0.0, 0.5, 0.0, 0.0]
    return chain(exp([0.1, 0.2, 0.3, 4.0, 5.0, 6.0]), exp(steps))


def along_x(positions: list[float]) -> FloatArray:
    T = np.tile(np.eye(4), (len(positions), 1, 1))
    T[:, 0, 3] = positions
    return T


def test_where_the_world_lies_does_not_matter(trajectory, rng):
    keyframes = np.array([5, 12, 33])
    poses = trajectory[keyframes] @ exp(rng.normal(size=(3, 6)) * 0.3)
    here = corrected(trajectory, keyframes, poses)
    there = corrected(FAR @ trajectory, keyframes, FAR @ poses)
    np.testing.assert_allclose(there, FAR @ here, atol=1e-8)


def test_before_the_first_and_after_the_last_the_motion_to_them_is_kept(trajectory, rng):
    keyframes = np.array([5, 33])
    poses = trajectory[keyframes] @ exp(rng.normal(size=(2, 6)))
    moved = corrected(trajectory, keyframes, poses)
    for scans, key in ((slice(0, 5), 0), (slice(34, 40), 1)):
        kept = inverse(trajectory[keyframes[key]]) @ trajectory[scans]
        np.testing.assert_allclose(inverse(poses[key]) @ moved[scans], kept, atol=1e-12)


def test_what_is_missing_is_spread_by_the_path_or_standing_still_by_the_scans():
    """Still before the second keyframe, driving after it; a quarter of that way lies before the fourth scan."""
    moved = corrected(along_x([0.0, 0.0, 0.0, 1.0, 4.0]), np.array([0, 2, 4]), along_x([0.0, 1.0, 7.0]))
    np.testing.assert_allclose(moved, along_x([0.0, 0.5, 1.0, 2.5, 7.0]), atol=1e-12)


def test_a_turn_that_was_missed_is_made_up_for_evenly():
    """Half-way, a scan is as far from where the first keyframe has it as from where the second has it."""
    before = along_x([0.0, 2.0, 4.0, 8.0])
    poses = before[[0, 3]] @ exp([[0.0] * 6, [0.1, 0.0, 0.4, 0.0, 0.5, 0.0]])
    moved = corrected(before, np.array([0, 3]), poses)
    from_first = log(inverse(before) @ moved)
    to_second = log(inverse(moved) @ poses[1] @ inverse(before[3]) @ before)
    np.testing.assert_allclose(from_first[2], to_second[2], atol=1e-12)
    np.testing.assert_allclose(from_first[1], to_second[1] / 3.0, atol=1e-12)
    assert np.linalg.norm(from_first[2, :3]) == pytest.approx(0.5 * np.linalg.norm(log(poses[1])[:3]))


def test_gtsam_reads_the_g2o_text_that_is_written(rng, tmp_path):
    """Poses turned every way, kilometres from the origin, to the last digits."""
    poses = exp(rng.normal(size=(5, 6)) * [1.0, 1.0, 1.0, 2000.0, 2000.0, 100.0])
    motions = exp(rng.normal(size=(6, 6)) * [1.0, 1.0, 1.0, 5.0, 5.0, 5.0])
    ends = [(0, 1), (1, 2), (2, 3), (4, 3), (4, 0), (2, 0)]
    A = rng.normal(size=(6, 6, 6)) * np.array([0.01, 0.02, 0.03, 0.3, 0.2, 0.1])[:, None]
    covariances = A @ A.swapaxes(1, 2) + np.diag([1e-5] * 3 + [1e-3] * 3)
    edges = [RelativePose(*pair, T, P) for pair, T, P in zip(ends, motions, covariances, strict=True)]
    path = tmp_path / "graph.g2o"
    path.write_text(format_g2o(poses, edges), encoding="utf-8")
    factors, values = gtsam.readG2o(str(path), True)
    assert (factors.size(), values.size()) == (6, 5)
    for key, pose in enumerate(poses):
        np.testing.assert_allclose(values.atPose3(key).matrix(), pose, atol=1e-9)
    for row, edge in enumerate(edges):
        factor = factors.at(row)
        assert list(factor.keys()) == [edge.first, edge.second]
        np.testing.assert_allclose(factor.measured().matrix(), edge.T_first_second, atol=1e-9)
        np.testing.assert_allclose(factor.noiseModel().covariance(), edge.covariance, rtol=1e-7, atol=1e-12)
