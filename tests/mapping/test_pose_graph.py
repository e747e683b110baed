"""Pose graphs whose optimal poses and outlier closures are known."""

from collections.abc import Sequence

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, rotation_angle
from lidarslam.core.trajectory import chain
from lidarslam.mapping.loops.closure import LoopClosure, RelativePose
from lidarslam.mapping.pose_graph.keyframe_graph import Attitude, first_connected
from lidarslam.mapping.pose_graph.optimizer import _LEAST, RelaxSchedule, bounded, optimise, relax

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
    wrong = rng.normal(size=(len(pairs), 6)) * [0.1, 0.1, 1.0, 8.0, 8.0, 1.0]
    return [
        RelativePose(a, b, inverse(poses[a]) @ poses[b] @ exp(xi), TIGHT)
        for (a, b), xi in zip(pairs, wrong, strict=True)
    ]


def drifted(edges: Sequence[RelativePose], count: int) -> FloatArray:
    """Poses from the chain alone."""
    steps = {e.first: e.T_first_second for e in edges if e.second == e.first + 1}
    return chain(np.eye(4), np.stack([steps[key] for key in range(count - 1)]))


def assert_near(actual: FloatArray, expected: FloatArray, tolerance: float) -> None:
    assert actual.shape == expected.shape
    apart = inverse(actual) @ expected
    assert float(np.linalg.norm(apart[:, :3, 3], axis=1).max()) < tolerance
    assert float(rotation_angle(apart).max()) < tolerance


def test_a_drifted_square_with_one_exact_closure_becomes_exact():
    """The chain is exact as well; only the initial poses have drifted."""
    truth = laps(LAP + 1)
    bend = exp(np.linspace(0.0, 1.0, LAP + 1)[:, None] * [0.05, -0.03, 0.3, 2.0, -1.0, 0.5])
    optimised = optimise(truth @ bend, chained(truth), [edge(truth, 0, LAP)])
    assert_near(optimised.poses, truth, 1e-6)
    assert optimised.inliers.tolist() == [True]


def test_a_loop_takes_the_drift_out(rng):
    truth = laps(2 * LAP)
    edges = with_errors(chained(truth, LOOSE), rng)
    start = drifted(edges, len(truth))
    loops = [edge(truth, key, key + LAP) for key in range(0, LAP, 4)]
    loops += [edge(truth, 0, key) for key in (20, 60)]
    after = optimise(start, edges, loops).poses
    errors = [np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1).max() for poses in (start, after)]
    assert errors[0] > 2.0
    assert errors[1] < 0.3 * errors[0]


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


@pytest.mark.parametrize(
    "covariance",
    [
        np.zeros((6, 6)),
        np.diag([1e-6, 1e-6, 1e-6, 1e-4, 1e-4, 1e8]),
        np.diag([-1e-6, 1e-6, 1e-6, 1e-4, 1e-4, 1e-4]),
        np.eye(6) + np.triu(np.ones((6, 6)), 1) * 1e-3,
    ],
)
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
    edges = [
        RelativePose(key, key + 1, one.T_first_second @ bend, covariance) for key, one in enumerate(chained(truth))
    ]
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
