"""The pose graph: keyframes, what was measured between them, and the poses that fit all of it best.

While a run lasts, iSAM2 (Kaess et al., IJRR 2012) keeps the poses up to date. In the end all of them are optimised
together, and `mapping.pose_graph.graduation` decides which loops to believe. Odometry and registration are kept.

Poses that no chain of edges joins are sessions of their own; the first pose of each is held where it is. When an edge
joins two, only the first of the two stays held. False loops that agree with one another, and outnumber the true ones
there, are believed; so is a single loop between two sessions, which nothing contradicts.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.core.state import Saved, State, stack
from mapping.pose_graph.components import Sessions
from mapping.pose_graph.edge_residuals import EdgeResiduals, bounded
from mapping.pose_graph.g2o import Edge, edges_state, restored_edges
from mapping.pose_graph.graduation import decide
from mapping.pose_graph.pose_graph_config import PoseGraphConfig

# Levenberg-Marquardt ends when a step gains a smaller share of the error: while loops are decided upon, and at last.
_NEARLY = 1e-4
_CONVERGED = 1e-9
# What is kept in mind of all that was done to a graph: iSAM2's linearisations depend on when it was asked for what.
_POSE, _EDGE, _UPDATE, _LOOK, _LOOK_AT_ALL, _OPTIMISE = range(6)


@dataclass(frozen=True, eq=False)
class Optimised:
    """A graph optimised as a whole.

    Attributes:
        poses: (N, 4, 4) T_world_lidar, in the order of keys.
        loop_weights: (L,) in the order in which loops were added: 1 is believed, 0 is not.
        error_before, error_after: half the sum of the edges' squared residuals, each whitened with its covariance, at
            the poses as they were and as they are; loops that are not believed are left out of both.
    """

    poses: FloatArray
    loop_weights: FloatArray
    error_before: float
    error_after: float


class PoseGraph:
    """Keyframes and edges, added as they come."""

    def __init__(self, config: PoseGraphConfig) -> None:
        self._config = config
        self._keys: list[int] = []
        self._edges: list[Edge] = []
        self._sessions = Sessions()
        self._values = gtsam.Values()  # of all poses, as good as known; iSAM2 may know better
        self._isam: gtsam.ISAM2 | None = None
        self._isam_knows_better = False
        self._held: set[int] = set()  # by iSAM2
        self._taken_in = (0, 0)  # poses and edges, by iSAM2
        self._weights: FloatArray | None = None  # (E,) of edges, while the last optimisation stands
        self._marginals: gtsam.ISAM2 | None = None
        self._added: list[FloatArray] = []  # poses as they were added
        self._done: list[tuple[int, int]] = []  # what, and with which key or edge

    def state(self) -> State:
        """What was added, and the order in which that and all else was done."""
        return {
            "keys": np.array(self._keys, dtype=np.int64),
            "added": stack(self._added, (4, 4)),
            "edges": edges_state(self._edges),
            "done": np.array(self._done, dtype=np.int64).reshape(-1, 2),
        }

    def restore(self, saved: Saved) -> None:
        """Go on from a state, before the first pose: do again all that was done, which gives the same numbers."""
        keys, edges = saved.array("keys", (None,), np.int64).tolist(), restored_edges(saved.part("edges"))
        added = dict(zip(keys, saved.array("added", (len(keys), 4, 4)), strict=True))
        try:
            for what, which in saved.array("done", (None, 2), np.int64).tolist():
                if what == _POSE:
                    self.add_pose(which, added[which])
                elif what == _EDGE:
                    self._append(edges[which])
                else:
                    _DO_AGAIN[what](self, which)
        except (KeyError, IndexError, ValueError) as error:
            raise saved.refuse(f"a pose graph that cannot have been: {error}") from error

    def add_pose(self, key: int, T_world_lidar: FloatArray) -> None:
        """Add a pose with its initial value (4, 4), best one that follows from `pose` of the last.

        Raises:
            ValueError: the key is not above all others, or not from 0 on.
        """
        if key < 0 or (self._keys and key <= self._keys[-1]):
            raise ValueError(f"keys must increase from 0 on, got {key} after {self._keys[-1:]}")
        self._keys.append(key)
        self._added.append(T_world_lidar)
        self._done.append((_POSE, key))
        self._sessions.add(key)
        self._values.insert(key, gtsam.Pose3(T_world_lidar))
        self._marginals = None

    def add_edge(self, edge: Edge) -> None:
        """Add a measurement between two poses that are there already; its covariance is made `bounded`.

        Raises:
            ValueError: a pose is not there, or numbers are not finite.
        """
        if edge.first == edge.second or not all(map(self._values.exists, (edge.first, edge.second))):
            raise ValueError(f"an edge joins two poses that were added, got {edge.first} and {edge.second}")
        if not np.isfinite(edge.T_first_second).all():
            raise ValueError(f"the motion from {edge.first} to {edge.second} must be finite")
        self._append(replace(edge, covariance=bounded(edge.covariance, self._config)))

    def _append(self, edge: Edge) -> None:
        self._done.append((_EDGE, len(self._edges)))
        self._edges.append(edge)
        self._sessions.join(edge.first, edge.second)
        self._weights = self._marginals = None

    def update(self) -> None:
        """Take in what was added since the last update."""
        self._done.append((_UPDATE, 0))
        poses, edges = self._taken_in
        joined = any(self._sessions.first(key) != key for key in self._held)
        if self._isam is None or joined:
            self._start_again(solve_first=joined)
        else:
            to_hold = {self._sessions.first(key) for key in self._keys[poses:]} - self._held
            self._take_in(self._isam, self._keys[poses:], self._edges[edges:], to_hold)
        assert self._isam is not None
        if any(edge.kind == "loop" for edge in self._edges[edges:]):
            for _ in range(self._config.iterations_after_loop):
                self._isam.update()

    def _start_again(self, solve_first: bool) -> None:
        """A new iSAM2. Two sessions that have been joined may have to be turned a lot, which it does not do well."""
        self._catch_up()
        if solve_first:
            self._values = self._solve(self._graph(None), _CONVERGED)
        self._isam, self._held = gtsam.ISAM2(_isam_parameters(self._config)), set()
        self._take_in(self._isam, self._keys, self._edges, self._sessions.all_first())

    def _take_in(self, isam: gtsam.ISAM2, keys: Sequence[int], edges: Sequence[Edge], to_hold: set[int]) -> None:
        values, graph = gtsam.Values(), gtsam.NonlinearFactorGraph()
        for key in keys:
            values.insert(key, self._values.atPose3(key))
        for key in sorted(to_hold):
            graph.add(self._anchor(key))
        for edge in edges:
            graph.add(self._factor(edge, None))
        isam.update(graph, values)
        self._held |= to_hold
        self._taken_in = (len(self._keys), len(self._edges))
        self._isam_knows_better, self._marginals = True, None

    def pose(self, key: int) -> FloatArray:
        """The best that is known of one pose, (4, 4); quicker than all of them."""
        self._done.append((_LOOK, key))
        known = self._isam_knows_better and self._isam is not None and self._isam.valueExists(key)
        pose = self._isam.calculateEstimatePose3(key) if known else self._values.atPose3(key)  # type: ignore[union-attr]
        return np.asarray(pose.matrix(), dtype=np.float64)

    def poses(self) -> FloatArray:
        """The best that is known, (N, 4, 4) in the order of keys: as optimised, as updated, or as added."""
        self._done.append((_LOOK_AT_ALL, 0))
        self._catch_up()
        return _matrices(self._values)

    def _catch_up(self) -> None:
        if self._isam_knows_better and self._isam is not None:
            self._values.update(self._isam.calculateEstimate())
        self._isam_knows_better = False

    def optimise(self) -> Optimised:
        """Optimise all poses together, and decide which loops to believe; the next update goes on from there."""
        self._done.append((_OPTIMISE, 0))
        self._catch_up()
        before, start = _matrices(self._values), self._values
        residuals = EdgeResiduals(self._edges, self._keys)
        loops = np.array([edge.kind == "loop" for edge in self._edges], dtype=bool)

        def solve(weights: FloatArray) -> FloatArray:
            if not weights[loops].any():
                self._values = start
            self._values = self._solve(self._graph(weights), _NEARLY)
            return residuals.squares(_matrices(self._values))

        weights = decide(loops, solve, self._config)
        self._values = self._solve(self._graph(weights), _CONVERGED)
        self._isam, self._held, self._taken_in = None, set(), (0, 0)
        self._weights, self._marginals = weights, None
        after = _matrices(self._values)
        errors = [0.5 * float(weights @ residuals.squares(poses)) for poses in (before, after)]
        return Optimised(after, weights[loops], *errors)

    def covariances(self, keys: Sequence[int]) -> FloatArray:
        """Covariances (K, 6, 6) of poses as they are, rotation first: of xi in T_true = T_estimate @ exp(xi).

        The first pose of a session is as certain as it is held, another as uncertain as the way from there. Loops that
        were not believed say nothing; before the first optimisation, or since something was added, those say little
        that are far off.
        """
        self.poses()
        if self._marginals is None:
            self._marginals = gtsam.ISAM2(_isam_parameters(self._config))
            self._marginals.update(self._graph(self._weights), self._values)
        found = [self._marginals.marginalCovariance(key) for key in keys]
        return np.array(found, dtype=np.float64).reshape(-1, 6, 6)

    def _graph(self, weights: FloatArray | None) -> gtsam.NonlinearFactorGraph:
        """All edges under the given weights (E,), or with iSAM2's kernel, and a held pose for each session."""
        graph, sessions = gtsam.NonlinearFactorGraph(), Sessions()
        for key in self._keys:
            sessions.add(key)
        for row, edge in enumerate(self._edges):
            weight = None if weights is None else float(weights[row])
            if weight != 0.0:
                graph.add(self._factor(edge, weight))
                sessions.join(edge.first, edge.second)
        for key in sorted(sessions.all_first()):
            graph.add(self._anchor(key))
        return graph

    def _solve(self, graph: gtsam.NonlinearFactorGraph, tolerance: float) -> gtsam.Values:
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setMaxIterations(self._config.max_iterations)
        parameters.setRelativeErrorTol(tolerance)
        parameters.setAbsoluteErrorTol(tolerance)
        return gtsam.LevenbergMarquardtOptimizer(graph, self._values, parameters).optimize()

    def _anchor(self, key: int) -> gtsam.PriorFactorPose3:
        rotation, translation = np.deg2rad(self._config.anchor_rotation_deg), self._config.anchor_translation_m
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([rotation] * 3 + [translation] * 3))
        return gtsam.PriorFactorPose3(key, self._values.atPose3(key), noise)

    def _factor(self, edge: Edge, weight: float | None) -> gtsam.BetweenFactorPose3:
        """GTSAM's residual is the logarithm of what T_first_second lacks, so covariances are as ours."""
        noise: gtsam.noiseModel.Base = gtsam.noiseModel.Gaussian.Covariance(edge.covariance / (weight or 1.0))
        if weight is None and edge.kind == "loop":
            kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(self._config.loop_kernel_sigmas)
            noise = gtsam.noiseModel.Robust.Create(kernel, noise)
        return gtsam.BetweenFactorPose3(edge.first, edge.second, gtsam.Pose3(edge.T_first_second), noise)


_DO_AGAIN: dict[int, Callable[[PoseGraph, int], object]] = {
    _UPDATE: lambda graph, _: graph.update(),
    _LOOK: lambda graph, key: graph.pose(key),
    _LOOK_AT_ALL: lambda graph, _: graph.poses(),
    _OPTIMISE: lambda graph, _: graph.optimise(),
}


def _isam_parameters(config: PoseGraphConfig) -> gtsam.ISAM2Params:
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(config.relinearise_above)
    parameters.relinearizeSkip = 1
    parameters.setFactorization("QR")  # Cholesky's gives up on chains that are loose in one direction only
    return parameters


def _matrices(values: gtsam.Values) -> FloatArray:
    """(N, 4, 4) in the order of keys."""
    rows = np.asarray(gtsam.utilities.extractPose3(values), dtype=np.float64).reshape(-1, 12)
    T: FloatArray = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = rows[:, :9].reshape(-1, 3, 3), rows[:, 9:]
    return T
