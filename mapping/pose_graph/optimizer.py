"""Pose-graph optimisation with GTSAM: maximum-likelihood keyframe poses given relative poses with covariances.

The first pose of each connected component is held. Loop closures are robust: under Cauchy's kernel while a run lasts,
by graduated non-convexity (Yang et al., RA-L 2020) in the end, as are positions of GNSS. False closures that agree with
one another and outnumber the true ones are kept; so is a single closure between two components, which nothing
contradicts. Attitudes by gravity hold roll and pitch.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import gtsam
import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.state import Stateful
from lidarslam.mapping.global_map.georeference import AntennaPosition
from lidarslam.mapping.loops.closure import LoopClosure, RelativePose
from lidarslam.mapping.pose_graph.keyframe_graph import Attitude, first_connected, squared_error

# Standard deviations of a pose that is held, radians and metres: firm compared with every edge, but no singular system.
_HELD = np.array([np.deg2rad(0.01)] * 3 + [0.001] * 3)
# Of a pose that positions hold, after their alignment.
_ALIGNED = np.array([np.deg2rad(5.0)] * 3 + [100.0] * 3)
# No edge is more precise than this, nor less by more than the ratio: the conditioning of double precision.
_LEAST = np.array([np.deg2rad(0.001)] * 3 + [0.0002] * 3)
_LARGEST_RATIO = 1e7
# Scale of Cauchy's kernel, in standard deviations.
_KERNEL_SIGMAS = 4.0
# A loop closure farther from the optimum than this is an outlier. GTSAM's 4.1 (99 % of chi-squared) would reject
# closures between trajectories that drift by more than their edges' model.
_INLIER_SIGMAS = 6.0
# Relative decrease of the cost at which Levenberg-Marquardt ends: while a run lasts, and in the end.
_NEARLY, _CONVERGED = 1e-4, 1e-9
# Factors of edges, each made once: rebuilding them takes longer than optimising from poses that are nearly right.
_factors: WeakKeyDictionary[RelativePose, gtsam.BetweenFactorPose3] = WeakKeyDictionary()
# An optimisation takes time in proportion to the keyframes. The next one waits for the hundredth part of their number,
# so that its time for each keyframe does not grow: none waits with 100 keyframes, 300 m or so with 10,000.
_PART = 100
# Only a closure farther from the present poses than its own deviation moves them: squared, in six dimensions.
_DEVIATIONS = 6.0


@dataclass(frozen=True, eq=False)
class Optimised:
    """An optimised graph: poses (N, 4, 4) T_world_lidar, and which loop closures (L,) and positions are inliers."""

    poses: FloatArray
    inliers: NDArray[np.bool_]
    position_inliers: NDArray[np.bool_]


def relax(
    poses: FloatArray, edges: Sequence[RelativePose], loops: Sequence[RelativePose], attitudes: Sequence[Attitude] = ()
) -> FloatArray:
    """Poses (N, 4, 4) optimised from where they are, loop closures under Cauchy's kernel.

    A batch solution after each closure, where iSAM2 would update: 0.2 s for 3,000 keyframes with 300 closures. It
    depends on nothing but its arguments, so that a resumed run is the same to the last digit.
    """
    graph = _graph(poses, edges, loops, attitudes)
    kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(_KERNEL_SIGMAS)
    for loop in loops:
        robust = gtsam.noiseModel.Robust.Create(kernel, _factor(loop).noiseModel())
        graph.add(gtsam.BetweenFactorPose3(loop.first, loop.second, gtsam.Pose3(loop.T_first_second), robust))
    return _matrices(_solve(graph, _values(poses), _NEARLY))


def optimise(
    poses: FloatArray, edges: Sequence[RelativePose], loops: Sequence[RelativePose], attitudes: Sequence[Attitude] = (),
    positions: Sequence[AntennaPosition] = (),
) -> Optimised:  # fmt: skip
    """All poses (N, 4, 4) together, and which loop closures and positions are inliers; others are never rejected.

    Poses are those of the map where there are positions, which hold it; else the first one of each component is held.
    """
    uncertain = [*map(_factor, loops), *map(_position_factor, positions)]
    inliers = np.ones(len(uncertain), dtype=np.bool_)
    if uncertain:
        poses = relax(poses, edges, loops, attitudes) if loops else poses
        graph = _graph(poses, edges, loops, attitudes, is_placed=bool(positions))
        known_inliers = list(range(graph.size()))
        for factor in uncertain:
            graph.add(factor)
        parameters = gtsam.GncLMParams()
        parameters.setLossType(gtsam.GncLossType.TLS)
        parameters.setKnownInliers(known_inliers)
        gnc = gtsam.GncLMOptimizer(graph, _values(poses), parameters)
        gnc.setInlierCostThresholds(0.5 * _INLIER_SIGMAS**2)
        poses = _matrices(gnc.optimize())
        inliers = np.asarray(gnc.getWeights())[len(known_inliers) :] > 0.5
    of_loops, of_positions = inliers[: len(loops)], inliers[len(loops) :]
    kept = [loop for loop, inlier in zip(loops, of_loops, strict=True) if inlier]
    graph = _graph(poses, edges, kept, attitudes, is_placed=bool(positions))
    for loop in kept:
        graph.add(_factor(loop))
    for position, inlier in zip(positions, of_positions, strict=True):
        if inlier:
            graph.add(_position_factor(position, position.repeats))
    return Optimised(_matrices(_solve(graph, _values(poses), _CONVERGED)), of_loops, of_positions)


def _graph(
    poses: FloatArray, edges: Sequence[RelativePose], loops: Sequence[RelativePose], attitudes: Sequence[Attitude],
    is_placed: bool = False,
) -> gtsam.NonlinearFactorGraph:  # fmt: skip
    """The edges and attitudes, and a prior on the first pose of each component that they and the loops make."""
    graph = gtsam.NonlinearFactorGraph()
    held = gtsam.noiseModel.Diagonal.Sigmas(_ALIGNED if is_placed else _HELD)
    pairs = [(edge.first, edge.second) for edge in (*edges, *loops)]
    for key in np.unique(first_connected(len(poses), pairs)).tolist():
        graph.add(gtsam.PriorFactorPose3(key, gtsam.Pose3(poses[key]), held))
    for edge in edges:
        graph.add(_factor(edge))
    for attitude in attitudes:
        noise = gtsam.noiseModel.Isotropic.Sigma(2, attitude.sigma)
        world, lidar = gtsam.Unit3(attitude.world), gtsam.Unit3(attitude.lidar)
        graph.add(gtsam.AttitudeFactorPose3(attitude.key, world, noise, lidar))
    return graph


def _factor(edge: RelativePose) -> gtsam.BetweenFactorPose3:
    """GTSAM's residual is the logarithm of the error in `T_first_second`, so covariances are the same."""
    if edge not in _factors:
        noise = gtsam.noiseModel.Gaussian.Covariance(bounded(edge.covariance))
        _factors[edge] = gtsam.BetweenFactorPose3(edge.first, edge.second, gtsam.Pose3(edge.T_first_second), noise)
    return _factors[edge]


def _position_factor(position: AntennaPosition, repeats: float = 1.0) -> gtsam.GPSFactorArm:
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.sqrt(repeats) * position.sigmas)
    return gtsam.GPSFactorArm(position.key, position.measured, position.antenna, noise)


def bounded(covariance: FloatArray) -> FloatArray:
    """The covariance (6, 6) made symmetric, its eigenvalues in units of the least deviations within bounds."""
    scaled = 0.5 * (covariance + covariance.T) / np.outer(_LEAST, _LEAST)
    values, vectors = np.linalg.eigh(scaled)
    if values[0] < 1.0 or values[-1] > _LARGEST_RATIO**2:
        scaled = (vectors * np.clip(values, 1.0, _LARGEST_RATIO**2)) @ vectors.T
    return np.asarray(0.5 * (scaled + scaled.T) * np.outer(_LEAST, _LEAST), dtype=np.float64)


def _solve(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, tolerance: float) -> gtsam.Values:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(tolerance)
    parameters.setAbsoluteErrorTol(tolerance)
    return gtsam.LevenbergMarquardtOptimizer(graph, start, parameters).optimize()


def _values(poses: FloatArray) -> gtsam.Values:
    values = gtsam.Values()
    for key, pose in enumerate(poses):
        values.insert(key, gtsam.Pose3(pose))
    return values


def _matrices(values: gtsam.Values) -> FloatArray:
    """(N, 4, 4) in the order of keys."""
    rows = np.asarray(gtsam.utilities.extractPose3(values), dtype=np.float64).reshape(-1, 12)
    T: FloatArray = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = rows[:, :9].reshape(-1, 3, 3), rows[:, 9:]
    return T


class RelaxSchedule(Stateful):
    """Collects accepted loop closures until the poses are optimised: not at every one of a long recording."""

    _waiting: list[LoopClosure]
    _keyframes: int  # when they were optimised last

    def __init__(self) -> None:
        self._waiting, self._keyframes = [], 0

    def is_due(self, found: Sequence[LoopClosure], poses: Sequence[FloatArray]) -> bool:
        """Whether to optimise now: closures since the last call contradict the poses (4, 4) of enough keyframes."""
        self._waiting += [closure for closure in found if closure.accepted]
        if _PART * (len(poses) - self._keyframes) < len(poses):
            return False
        waiting, self._waiting = self._waiting, []
        if not any(squared_error(closure, poses) > _DEVIATIONS for closure in waiting):
            return False
        self._keyframes = len(poses)
        return True
