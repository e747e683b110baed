"""Pose graphs whose best poses, covariances and false loops are known."""

from collections.abc import Callable, Sequence
from pathlib import Path

import gtsam
import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, adjoint, exp, inverse, log, rotation_angle
from lidarslam.core.state import Saved, State
from lidarslam.core.trajectory import chain
from mapping.pose_graph.components import Sessions
from mapping.pose_graph.edge_residuals import EdgeResiduals, bounded
from mapping.pose_graph.g2o import Edge, EdgeKind, read_g2o
from mapping.pose_graph.graduation import decide, truncated_weights
from mapping.pose_graph.optimizer import PoseGraph
from mapping.pose_graph.pose_graph_config import PoseGraphConfig

CONFIG = PoseGraphConfig()
PRECISE = PoseGraphConfig(relinearise_above=1e-6, iterations_after_loop=15)
LOOSE = np.diag([0.02, 0.01, 0.03, 0.3, 0.2, 0.1]) ** 2
TIGHT = np.diag([0.002, 0.001, 0.003, 0.03, 0.02, 0.01]) ** 2
LAP = 40
FALSE = ((5, 45), (17, 62), (30, 74), (8, 50), (22, 71), (11, 66))


def laps(count: int) -> FloatArray:
    """Keyframes 1 m apart round a square of 10 m, as often as needed."""
    steps = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0], (count - 1, 1))
    steps[9::10, 2] = np.pi / 2
    steps[9::10, 3:] = 0.0
    steps[9::10, 3] = np.pi / 4  # turn on a quarter of a circle
    steps[9::10, 4] = 0.0
    return chain(np.eye(4), exp(steps))


def edge(poses: FloatArray, first: int, second: int, covariance: FloatArray, kind: EdgeKind) -> Edge:
    """What an errorless sensor measures."""
    return Edge(first, second, inverse(poses[first]) @ poses[second], covariance, kind)


def chained(poses: FloatArray, covariance: FloatArray = TIGHT, kind: EdgeKind = "refinement") -> list[Edge]:
    return [edge(poses, key, key + 1, covariance, kind) for key in range(len(poses) - 1)]


def with_errors(edges: Sequence[Edge], rng: np.random.Generator) -> list[Edge]:
    """Wrong by as much as their covariances say."""
    roots = [np.linalg.cholesky(e.covariance) for e in edges]
    return [
        Edge(e.first, e.second, e.T_first_second @ exp(root @ rng.normal(size=6)), e.covariance, e.kind)
        for e, root in zip(edges, roots, strict=True)
    ]


def false_edges(poses: FloatArray, pairs: Sequence[tuple[int, int]], rng: np.random.Generator) -> list[Edge]:
    """Far from the truth, each in its own way."""
    wrong = rng.normal(size=(len(pairs), 6)) * [0.1, 0.1, 1.0, 8.0, 8.0, 1.0]
    return [
        Edge(a, b, inverse(poses[a]) @ poses[b] @ exp(xi), TIGHT, "loop")
        for (a, b), xi in zip(pairs, wrong, strict=True)
    ]


def drifted(edges: Sequence[Edge], count: int) -> FloatArray:
    """Poses from the chain alone."""
    steps = {e.first: e.T_first_second for e in edges if e.second == e.first + 1}
    return chain(np.eye(4), np.stack([steps[key] for key in range(count - 1)]))


def graph_of(poses: FloatArray, edges: Sequence[Edge], config: PoseGraphConfig = CONFIG) -> PoseGraph:
    graph = PoseGraph(config)
    for key, pose in enumerate(poses):
        graph.add_pose(key, pose)
    for e in edges:
        graph.add_edge(e)
    return graph


def assert_near(actual: FloatArray, expected: FloatArray, tolerance: float) -> None:
    assert actual.shape == expected.shape
    apart = inverse(actual) @ expected
    assert float(np.linalg.norm(apart[:, :3, 3], axis=1).max()) < tolerance
    assert float(rotation_angle(apart).max()) < tolerance


def test_a_drifted_square_with_one_exact_closure_becomes_exact() -> None:
    """The chain is exact as well; only the initial poses have drifted."""
    truth = laps(LAP + 1)
    bend = exp(np.linspace(0.0, 1.0, LAP + 1)[:, None] * [0.05, -0.03, 0.3, 2.0, -1.0, 0.5])
    edges = [*chained(truth), edge(truth, 0, LAP, TIGHT, "loop")]
    optimised = graph_of(truth @ bend, edges).optimise()
    assert_near(optimised.poses, truth, 1e-6)
    assert optimised.loop_weights.tolist() == [1.0]
    assert optimised.error_before > 100.0
    assert optimised.error_after < 1e-6


def test_a_loop_takes_the_drift_out(rng: np.random.Generator) -> None:
    truth = laps(2 * LAP)
    edges = with_errors(chained(truth, LOOSE), rng)
    start = drifted(edges, len(truth))
    loops = [edge(truth, key, key + LAP, TIGHT, "loop") for key in range(0, LAP, 4)]
    loops += [edge(truth, 0, key, TIGHT, "loop") for key in (20, 60)]
    after = graph_of(start, edges + loops).optimise().poses
    errors = [np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1).max() for poses in (start, after)]
    assert errors[0] > 2.0
    assert errors[1] < 0.3 * errors[0]


@pytest.mark.parametrize(("true", "false"), [(3, 1), (10, 3), (10, 6)])
def test_false_loops_are_rejected_and_change_nothing(true: int, false: int, rng: np.random.Generator) -> None:
    truth = laps(2 * LAP)
    edges = with_errors(chained(truth), rng)
    start = drifted(edges, len(truth))
    keys = np.linspace(0, LAP - 1, true).astype(int).tolist()
    loops = with_errors([edge(truth, key, key + LAP, TIGHT, "loop") for key in keys], rng)
    wrong = false_edges(truth, FALSE[:false], rng)
    expected = graph_of(start, edges + loops).optimise()
    found = graph_of(start, edges + wrong + loops).optimise()
    assert found.loop_weights.tolist() == [0.0] * false + [1.0] * true
    assert_near(found.poses, expected.poses, 1e-6)
    assert found.error_after == pytest.approx(expected.error_after, rel=1e-6)


def test_a_single_false_loop_is_rejected_where_the_chain_would_have_to_break(rng: np.random.Generator) -> None:
    truth = laps(2 * LAP)
    edges = chained(truth)
    found = graph_of(truth, edges + false_edges(truth, FALSE[:1], rng)).optimise()
    assert found.loop_weights.tolist() == [0.0]
    assert_near(found.poses, truth, 1e-6)


def test_false_loops_that_agree_and_outnumber_the_true_are_believed(rng: np.random.Generator) -> None:
    """A known limit: the second lap is said to lie 10 m aside, by six against one, and the chain cannot tell."""
    truth = laps(2 * LAP)
    aside = np.eye(4)
    aside[:3, 3] = [0.0, 10.0, 0.0]
    pairs = [(key, key + LAP) for key in range(0, 12, 2)]
    lies = [Edge(a, b, inverse(truth[a]) @ aside @ truth[b], TIGHT, "loop") for a, b in pairs]
    chain_edges = with_errors(chained(truth, 4.0 * LOOSE), rng)
    edges = [*chain_edges, edge(truth, 5, 5 + LAP, TIGHT, "loop"), *lies]
    assert graph_of(drifted(chain_edges, len(truth)), edges).optimise().loop_weights.tolist() == [0.0] + [1.0] * 6


def test_odometry_and_refinement_are_weighed_by_their_covariances() -> None:
    """Two measurements of one motion: the estimate is their mean, weighted by information."""
    graph = PoseGraph(CONFIG)
    graph.add_pose(0, np.eye(4))
    graph.add_pose(1, np.eye(4))
    far, near = exp([0, 0, 0, 2.0, 0, 0]), exp([0, 0, 0, 1.0, 0, 0])
    graph.add_edge(Edge(0, 1, far, LOOSE, "odometry"))
    graph.add_edge(Edge(0, 1, near, LOOSE / 9.0, "refinement"))
    optimised = graph.optimise()
    np.testing.assert_allclose(optimised.poses[1], exp([0, 0, 0, 1.1, 0, 0]), atol=1e-8)
    # 0.9 and 0.1 away, at deviations of 0.3 and 0.1
    assert optimised.error_after == pytest.approx(0.5 * (9.0 + 1.0))
    assert optimised.error_before == pytest.approx(0.5 * ((2 / 0.3) ** 2 + (1 / 0.1) ** 2))
    assert len(optimised.loop_weights) == 0


def test_the_order_of_a_covariance_is_rotation_first() -> None:
    """Of two chains around a square of four poses, that bends which may: in translation along y, not in rotation."""
    graph = PoseGraph(CONFIG)
    for key in range(3):
        graph.add_pose(key, np.eye(4))
    bendy = np.diag([1e-3, 1e-3, 1e-3, 1e-3, 1.0, 1e-3]) ** 2  # sure of all but translation along y
    stiff = np.diag([1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3]) ** 2
    graph.add_edge(Edge(0, 1, np.eye(4), bendy, "refinement"))
    graph.add_edge(Edge(1, 2, np.eye(4), stiff, "refinement"))
    graph.add_edge(Edge(0, 2, exp([0, 0, 0, 0, 0.5, 0]), stiff, "refinement"))
    poses = graph.optimise().poses
    assert_near(poses, exp(np.array([[0.0] * 6, [0, 0, 0, 0, 0.5, 0], [0, 0, 0, 0, 0.5, 0]])), 1e-5)


def test_marginals_of_two_poses_are_those_of_the_edge_between() -> None:
    T = exp([0.3, -0.2, 0.5, 2.0, 1.0, -0.5])
    graph = graph_of(np.stack([np.eye(4), T]), [Edge(0, 1, T, LOOSE, "refinement")])
    held = np.diag([np.deg2rad(CONFIG.anchor_rotation_deg)] * 3 + [CONFIG.anchor_translation_m] * 3) ** 2
    A = adjoint(inverse(T))
    found = graph.covariances([1, 0])
    np.testing.assert_allclose(found[0], LOOSE + A @ held @ A.T, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found[1], held, rtol=1e-6, atol=1e-15)
    assert graph.covariances([]).shape == (0, 6, 6)


def test_uncertainty_grows_along_the_chain_and_shrinks_at_a_loop() -> None:
    truth = laps(LAP + 1)
    graph = graph_of(truth, chained(truth))
    graph.update()
    before = np.linalg.det(graph.covariances(range(LAP + 1)))
    assert (np.diff(before) > 0.0).all()
    graph.add_edge(edge(truth, 0, LAP, TIGHT, "loop"))
    graph.update()
    updated = graph.covariances(range(LAP + 1))
    assert (np.linalg.det(updated)[1:] < before[1:]).all()
    assert np.linalg.det(updated[LAP]) < np.linalg.det(updated[LAP // 2])
    graph.optimise()
    np.testing.assert_allclose(graph.covariances(range(LAP + 1)), updated, rtol=1e-3, atol=1e-9)
    graph.add_edge(edge(truth, 0, LAP // 2, TIGHT, "loop"))
    assert np.linalg.det(graph.covariances([LAP // 2])[0]) < 0.5 * np.linalg.det(updated[LAP // 2])


def test_a_rejected_loop_says_nothing_about_covariances(rng: np.random.Generator) -> None:
    truth = laps(2 * LAP)
    without, with_false = graph_of(truth, chained(truth)), graph_of(truth, chained(truth))
    for e in false_edges(truth, FALSE[:1], rng):
        with_false.add_edge(e)
    for graph in (without, with_false):
        graph.optimise()
    np.testing.assert_allclose(with_false.covariances([79]), without.covariances([79]), rtol=1e-6)


def test_isam_agrees_with_the_batch(rng: np.random.Generator) -> None:
    """Without loops that a kernel weakens, both have the same minimum."""
    truth = laps(2 * LAP)
    edges = with_errors([*chained(truth), *chained(truth, LOOSE, "odometry")], rng)
    edges += with_errors([edge(truth, key, key + LAP, TIGHT, "refinement") for key in range(0, LAP, 5)], rng)
    graph = PoseGraph(PRECISE)
    for key in range(len(truth)):
        motion = edges[key - 1].T_first_second
        graph.add_pose(key, truth[0] if key == 0 else graph.pose(key - 1) @ motion)
        for e in edges:
            if e.second == key:
                graph.add_edge(e)
        graph.update()
    for _ in range(10):
        graph.update()
    online = graph.poses()
    np.testing.assert_allclose(graph.pose(70), online[70], atol=1e-12)
    optimised = graph.optimise()
    assert_near(online, optimised.poses, 1e-5)
    np.testing.assert_array_equal(graph.poses(), optimised.poses)
    np.testing.assert_array_equal(graph.pose(70), optimised.poses[70])


def test_isam_closes_loops_and_bears_false_ones(rng: np.random.Generator) -> None:
    truth = laps(2 * LAP)
    edges = with_errors(chained(truth, LOOSE), rng)
    graph = graph_of(drifted(edges, len(truth)), edges)
    graph.update()
    drift = np.linalg.norm(log(inverse(truth[60]) @ graph.pose(60))[3:])
    loops = [edge(truth, 0, key, TIGHT, "loop") for key in range(4, 80, 4)]
    for e in loops[:12] + false_edges(truth, FALSE[:3], rng) + loops[12:]:
        graph.add_edge(e)
        graph.update()
    assert drift > 1.0
    assert_near(graph.poses()[4:80:4], truth[4:80:4], 0.1)


@pytest.mark.parametrize("optimised", [False, True])
def test_a_graph_that_is_restored_goes_on_as_it_would_have(
    rng: np.random.Generator, through_disk: Callable[[State], Saved], optimised: bool
) -> None:
    """To the last bit, though iSAM2 was updated now and then, looked at, and had loops to bear."""
    truth = laps(80)
    edges = with_errors([*chained(truth), edge(truth, 3, 43, TIGHT, "loop"), edge(truth, 20, 60, TIGHT, "loop")], rng)
    start = drifted(edges, 80)

    def feed(graph: PoseGraph, keys: range) -> None:
        for key in keys:
            graph.add_pose(key, graph.pose(key - 1) @ edges[key - 1].T_first_second if key else start[0])
            for one in edges:
                if one.second == key:
                    graph.add_edge(one)
            if key % 3 == 2:
                graph.update()
            if key % 5 == 4:
                graph.poses()

    whole, begun, restored = PoseGraph(CONFIG), PoseGraph(CONFIG), PoseGraph(CONFIG)
    feed(whole, range(50))
    feed(begun, range(50))
    if optimised:
        whole.optimise()
        begun.optimise()
    restored.restore(through_disk(begun.state()))
    for graph in (whole, restored):
        feed(graph, range(50, 80))
    np.testing.assert_array_equal(restored.poses(), whole.poses())
    np.testing.assert_array_equal(restored.covariances([0, 79]), whole.covariances([0, 79]))
    np.testing.assert_array_equal(restored.optimise().poses, whole.optimise().poses)


def test_the_graph_goes_on_after_it_was_optimised() -> None:
    truth = laps(2 * LAP)
    edges = chained(truth)
    graph = graph_of(truth[:LAP], edges[: LAP - 1])
    graph.optimise()
    for key in range(LAP, 2 * LAP):
        graph.add_pose(key, graph.pose(key - 1) @ edges[key - 1].T_first_second)
        graph.add_edge(edges[key - 1])
        graph.update()
    assert_near(graph.poses(), truth, 1e-6)


@pytest.mark.parametrize("by_update", [False, True])
def test_sessions_that_nothing_joins_stay_where_they_are(by_update: bool) -> None:
    truth = laps(20)
    elsewhere = exp([0.1, 0.2, 3.0, 500.0, 300.0, 20.0]) @ truth
    second = [Edge(20 + e.first, 20 + e.second, e.T_first_second, e.covariance, e.kind) for e in chained(truth)]
    graph = graph_of(np.concatenate([truth, elsewhere]), chained(truth) + second)
    if by_update:
        graph.update()
        poses = graph.poses()
    else:
        poses = graph.optimise().poses
    assert_near(poses, np.concatenate([truth, elsewhere]), 1e-6)
    np.testing.assert_allclose(graph.covariances([39]), graph.covariances([19]), rtol=1e-4, atol=1e-12)


@pytest.mark.parametrize("by_update", [False, True])
def test_loops_bring_two_sessions_together(by_update: bool) -> None:
    """The second session is begun in a world of its own, turned half round and far away."""
    truth = laps(2 * LAP)
    edges = [e for e in chained(truth) if e.second != LAP]
    lost = exp([0.0, 0.1, 2.5, 80.0, -50.0, 3.0]) @ truth[LAP:]
    graph = graph_of(np.concatenate([truth[:LAP], lost]), edges)
    if by_update:
        graph.update()
    for key in (3, 13, 33):
        graph.add_edge(edge(truth, key, key + LAP, TIGHT, "loop"))
    if by_update:
        for _ in range(5):
            graph.update()
        assert_near(graph.poses(), truth, 1e-4)
    optimised = graph.optimise()
    assert optimised.loop_weights.tolist() == [1.0] * 3
    assert_near(optimised.poses, truth, 1e-5)


def test_a_session_is_left_alone_when_the_loops_to_it_contradict_one_another(rng: np.random.Generator) -> None:
    truth = laps(2 * LAP)
    edges = [e for e in chained(truth) if e.second != LAP]
    graph = graph_of(truth, edges + false_edges(truth, ((3, 43), (13, 63)), rng))
    optimised = graph.optimise()
    assert optimised.loop_weights.sum() <= 1.0
    assert np.isfinite(graph.covariances([2 * LAP - 1])).all()


@pytest.mark.parametrize(
    "covariance",
    [
        np.zeros((6, 6)),
        np.full((6, 6), 1e-12),
        np.diag([1e-6, 1e-6, 1e-6, 1e-4, 1e-4, np.inf]),
        np.diag([1e300, 1e-6, 1e-6, 1e-4, 1e-4, 1e-4]),
        np.diag([-1e-6, 1e-6, 1e-6, 1e-4, 1e-4, 1e-4]),
        np.eye(6) + np.triu(np.ones((6, 6)), 1) * 1e-3,
    ],
)
def test_bad_covariances_are_bounded_and_do_no_harm(covariance: FloatArray) -> None:
    kept = bounded(covariance, CONFIG)
    np.testing.assert_array_equal(kept, kept.T)
    deviations = np.sqrt(np.linalg.eigvalsh(kept))
    assert deviations[0] > 0.9 * min(np.deg2rad(CONFIG.least_rotation_deg), CONFIG.least_translation_m)
    truth = laps(10)
    graph = graph_of(truth @ exp([0, 0, 0.01, 0.1, 0, 0]), [*chained(truth, covariance), *chained(truth)])
    graph.update()
    optimised = graph.optimise()
    first = optimised.poses[0]
    assert_near(optimised.poses, first @ inverse(truth[0]) @ truth, 1e-5)
    assert np.isfinite(graph.covariances([9])).all()


@pytest.mark.parametrize(
    "variances",
    [
        [1e-6, 1e-6, 1e-6, np.inf, 1e-4, 1e-4],
        [1e-12, 1e-12, 1e-12, np.inf, 1e-12, 1e-12],
        [np.inf, np.inf, np.inf, 1e-8, 1e-8, 1e-8],
        [np.inf] * 6,
        [0.0] * 6,
    ],
)
def test_a_chain_that_knows_nothing_of_some_directions_can_be_solved(variances: list[float]) -> None:
    truth = laps(2 * LAP)
    graph = graph_of(truth, chained(truth, np.diag(variances)))
    graph.update()
    graph.add_edge(edge(truth, 0, len(truth) - 1, TIGHT, "loop"))
    graph.update()
    assert_near(graph.poses(), truth, 1e-6)
    assert_near(graph.optimise().poses, truth, 1e-6)
    assert np.isfinite(graph.covariances([79, 40])).all()


def test_a_good_covariance_is_kept() -> None:
    A = np.random.default_rng(3).normal(size=(6, 6)) * 0.1
    np.testing.assert_allclose(bounded(A @ A.T, CONFIG), A @ A.T, rtol=1e-12)
    least = bounded(np.zeros((6, 6)), CONFIG)
    sigmas = [np.deg2rad(CONFIG.least_rotation_deg)] * 3 + [CONFIG.least_translation_m] * 3
    np.testing.assert_allclose(least, np.diag(sigmas) ** 2, rtol=1e-12)


def test_squared_residuals_are_those_of_gtsam(rng: np.random.Generator) -> None:
    """GTSAM's error is half of them."""
    poses = exp(rng.normal(size=(4, 6)))
    keys = [2, 3, 7, 9]
    A = rng.normal(size=(6, 6))
    edges = [
        Edge(keys[a], keys[b], exp(rng.normal(size=6)), A @ A.T + np.eye(6), "loop")
        for a, b in ((0, 1), (3, 1), (2, 0))
    ]
    values, factors = gtsam.Values(), []
    for key, pose in zip(keys, poses, strict=True):
        values.insert(key, gtsam.Pose3(pose))
    for e in edges:
        noise = gtsam.noiseModel.Gaussian.Covariance(e.covariance)
        factors.append(gtsam.BetweenFactorPose3(e.first, e.second, gtsam.Pose3(e.T_first_second), noise))
    expected = [2.0 * factor.error(values) for factor in factors]
    np.testing.assert_allclose(EdgeResiduals(edges, keys).squares(poses), expected, rtol=1e-9)


def test_weights_go_from_nearly_alike_to_all_or_nothing() -> None:
    squares = np.array([0.0, 10.0, 24.9, 25.1, 1e4])
    np.testing.assert_array_equal(truncated_weights(squares, 1e6, 25.0).round(), [1.0, 1.0, 1.0, 0.0, 0.0])
    flat = truncated_weights(squares, 0.01, 25.0)
    assert flat[0] == 1.0
    assert (np.diff(flat[1:]) < 0.0).all()
    # equation 14 at 100: sqrt(25 * 0.01 * 1.01 / 100) - 0.01
    assert truncated_weights(np.array([100.0]), 0.01, 25.0)[0] == pytest.approx(0.0402494, abs=1e-7)


def recorded(answer: Callable[[FloatArray], Sequence[float]], loops: int) -> tuple[FloatArray, list[list[float]]]:
    """The weights decided upon beside one edge that is no loop, and all that were tried."""
    asked = []

    def solve(weights: FloatArray) -> FloatArray:
        asked.append(weights.tolist())
        return np.array(answer(weights))

    weights = decide(np.array([False] + [True] * loops), solve, CONFIG)
    assert asked[-1] == weights.tolist()
    return weights, asked


def test_no_loop_is_doubted_when_together_they_cost_next_to_nothing() -> None:
    weights, asked = recorded(lambda _: [1.0, 2.0, 30.0], loops=2)
    assert weights.tolist() == [1.0, 1.0, 1.0]
    assert len(asked) == 1


def test_a_loop_that_fits_only_when_everything_else_is_bent_is_not_believed() -> None:
    weights, _ = recorded(lambda w: [500.0 * w[1], 1e6 * (1.0 - w[1]) + 1.0], loops=1)
    assert weights.tolist() == [1.0, 0.0]


def test_loops_that_fit_are_all_believed_when_that_costs_less() -> None:
    """Graduation ends where none is believed, at 72; with both it is 50."""
    weights, asked = recorded(lambda w: [30.0, 10.0, 10.0] if w.min() == 1.0 else [0.0, 1e6, 1e6], loops=2)
    assert weights.tolist() == [1.0, 1.0, 1.0]
    assert [1.0, 0.0, 0.0] in asked


def test_a_loop_that_fits_after_all_is_taken_back() -> None:
    """With full weight on the first loop, the second comes within the limit."""
    weights, _ = recorded(lambda w: [40.0, 1.0, 100.0 if w[3] > 0.0 or 0.0 < w[2] < 0.5 else 9.0, 1e5], loops=3)
    assert weights.tolist() == [1.0, 1.0, 1.0, 0.0]


def test_keys_must_increase_and_edges_join_known_poses() -> None:
    graph = PoseGraph(CONFIG)
    graph.add_pose(3, np.eye(4))
    for key in (3, 2):
        with pytest.raises(ValueError, match="increase"):
            graph.add_pose(key, np.eye(4))
    graph.add_pose(8, np.eye(4))
    with pytest.raises(ValueError, match="increase"):
        PoseGraph(CONFIG).add_pose(-1, np.eye(4))
    for first, second in ((3, 4), (4, 8), (8, 8)):
        with pytest.raises(ValueError, match="joins two poses"):
            graph.add_edge(Edge(first, second, np.eye(4), TIGHT, "loop"))
    with pytest.raises(ValueError, match="covariance"):
        graph.add_edge(Edge(3, 8, np.eye(4), TIGHT * np.nan, "loop"))
    with pytest.raises(ValueError, match="covariance"):
        graph.add_edge(Edge(3, 8, np.eye(4), np.eye(3), "loop"))
    with pytest.raises(ValueError, match="finite"):
        graph.add_edge(Edge(3, 8, np.eye(4) * np.nan, TIGHT, "loop"))
    graph.update()
    np.testing.assert_allclose(graph.poses(), [np.eye(4)] * 2, atol=1e-12)


def test_an_empty_graph_has_no_poses() -> None:
    graph = PoseGraph(CONFIG)
    graph.update()
    assert graph.poses().shape == (0, 4, 4)
    optimised = graph.optimise()
    assert optimised.poses.shape == (0, 4, 4)
    assert (optimised.error_before, optimised.error_after, len(optimised.loop_weights)) == (0.0, 0.0, 0)


def test_a_session_is_named_by_its_first_key() -> None:
    sessions = Sessions()
    for key in range(8):
        sessions.add(key)
    for first, second in ((6, 7), (4, 5), (5, 7), (1, 2)):
        sessions.join(first, second)
    assert [sessions.first(key) for key in range(8)] == [0, 1, 1, 3, 4, 4, 4, 4]
    assert sessions.all_first() == {0, 1, 3, 4}


@pytest.mark.real_data
def test_a_real_graph_ends_where_gtsam_ends_with_it(real_data: Path) -> None:
    path = real_data / "trajectories" / "parking-garage.g2o"
    if not path.is_file():
        pytest.skip(f"no {path.name} in the real data")
    read = read_g2o(path)
    graph = PoseGraph(CONFIG)
    for key, pose in zip(read.keys.tolist(), read.poses, strict=True):
        graph.add_pose(key, pose)
    for e in read.edges:
        graph.add_edge(e)
    optimised = graph.optimise()
    factors, values = gtsam.readG2o(str(path), True)
    assert optimised.error_before == pytest.approx(factors.error(values), rel=1e-6)
    factors.add(gtsam.PriorFactorPose3(0, values.atPose3(0), gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
    found = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    assert optimised.error_after == pytest.approx(factors.error(found), rel=1e-6)
    assert optimised.loop_weights.all()
