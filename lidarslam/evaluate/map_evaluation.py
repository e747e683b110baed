"""A map held against a reference map: aligned, compared, its crispness measured."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evaluation.comparison.comparison import MapErrors
from evaluation.map.alignment import GLOBAL, MapAlignment, align_map
from evaluation.map.entropy import MapEntropy, map_entropy
from evaluation.map.metrics import DEFAULT_SPACING_M, F_SCORE_THRESHOLDS_M, MapComparison, compare_maps
from evaluation.trajectory.alignment import align
from evaluation.trajectory.association import associate
from evaluation.trajectory.metrics import TrajectoryMetrics
from lidarslam.core.errors import ConfigError, InputError
from lidarslam.core.geometry import FloatArray, inverse, is_rigid, orthonormalize, transform_points
from lidarslam.core.trajectory import Trajectory
from lidarslam.core.trajectory_io import parse_numbers
from lidarslam.evaluate.inputs import Estimate, read_estimate
from lidarslam.evaluate.reference_cloud import read_cloud
from lidarslam.evaluate.reference_map import ReferenceMap

AUTO, TRAJECTORY, NONE = "auto", "trajectory", "none"

_DRAWN_POINTS = 200_000


@dataclass(frozen=True)
class MapOptions:
    """How maps are compared.

    Attributes:
        alignment: where `T_reference_map` comes from. "trajectory": the alignment of the trajectory with one in the
            reference map's world; "none": the map is in the reference's frame already; "global": a search; or the
            name of a text file with the 4x4 matrix. "auto": the trajectory where it is known to be in the reference
            map's world, else whichever of trajectory, none and global fits first.
        refine: whether ICP follows; None: unless the alignment is "none".
        spacing_m: both clouds are thinned to one point in cells of this size.
        max_range_m: how far the sensor sees; None: as far as the run's map reaches.
    """

    alignment: str = AUTO
    refine: bool | None = None
    spacing_m: float = DEFAULT_SPACING_M
    max_range_m: float | None = None

    def __post_init__(self) -> None:
        if self.alignment == GLOBAL and self.refine is False:
            raise ConfigError("a global search is good to a metre only; let --refine follow it")


@dataclass(frozen=True, eq=False)
class MapEvaluation:
    """What came of it.

    Attributes:
        reference: what the map was held against, in words.
        alignment: how it was brought there.
        comparison: the errors, in numbers and point by point.
        entropy: crispness of the map by itself; None when it is too sparse.
        positions: (K, 3) where the sensor was, in the reference's frame.
        max_range_m: how far it sees.
    """

    reference: str
    alignment: MapAlignment
    comparison: MapComparison
    entropy: MapEntropy | None
    positions: FloatArray
    max_range_m: float

    @property
    def json(self) -> dict[str, object]:
        """The content of metrics.json's "map"."""
        entropy = None if self.entropy is None else self.entropy.mean
        return {**self.comparison.metrics.to_json(), "mean_map_entropy": entropy}

    @property
    def errors(self) -> MapErrors:
        """The map's errors point by point, thinned for drawing."""
        errors = self.comparison.map_errors
        step = max(1, -(-len(errors.points) // _DRAWN_POINTS))
        return MapErrors(errors.points[::step], errors.distances_m[::step])

    def warnings(self) -> Iterator[str]:
        """What the reader of the figures must know."""
        alignment, gap_m = self.alignment, self.comparison.map_gap_m
        if not alignment.is_trustworthy:
            yield (
                f"only {100.0 * alignment.fitness:.0f} % of the map lies within {alignment.inlier_m:g} m of the"
                " reference: the map is bent, or its alignment is wrong; look at it with --errors FILE.ply"
            )
        if gap_m is not None and gap_m > F_SCORE_THRESHOLDS_M[0]:
            yield (
                f"the map's points are {gap_m:.2f} m apart, so that completeness and the F-score at"
                f" {F_SCORE_THRESHOLDS_M[0]:g} m say more about its voxels than about its errors;"
                " run again with --set global_map.voxel_size_m=0.05"
            )


def evaluate_map_of_run(
    run: Path, metrics: TrajectoryMetrics | None, reference: ReferenceMap, options: MapOptions | None = None
) -> MapEvaluation:
    """Hold a run's map against a reference map.

    Args:
        run: the run directory.
        metrics: of its trajectory (`trajectory.tum`), None when that has no reference.
        reference: from `load_reference_map` or `find_reference_map`.
        options: the defaults when None.

    Raises:
        InputError: the run has no map, or it cannot be aligned.
    """
    estimate = read_estimate(run)
    return evaluate_map(estimate, read_map(estimate), metrics, reference, options)


def read_map(estimate: Estimate) -> FloatArray:
    """The map's points (N, 3).

    Raises:
        InputError: there is none, or it cannot be read.
    """
    if estimate.map_file is None:
        advice = "name it with --map FILE" if estimate.run is None else "no scan of it could be believed"
        raise InputError(f"{estimate.poses.what}: has no map to compare; {advice}")
    return read_cloud(estimate.map_file)


def evaluate_map(
    estimate: Estimate,
    map_points: FloatArray,
    metrics: TrajectoryMetrics | None,
    reference: ReferenceMap,
    options: MapOptions | None = None,
) -> MapEvaluation:
    """Hold a map (N, 3), in the world of the estimate's poses, against a reference map; else as `evaluate_map_of_run`.

    Raises:
        InputError: it cannot be aligned.
    """
    options = options or MapOptions()
    T_reference_world, positions = _along_trajectory(estimate, metrics, reference)
    alignment = _align(map_points, reference, T_reference_world, options)
    max_range_m = options.max_range_m or estimate.config.global_map.max_range_m
    positions = transform_points(alignment.T_reference_map, positions)
    aligned = transform_points(alignment.T_reference_map, map_points)
    return MapEvaluation(
        reference=reference.what,
        alignment=alignment,
        comparison=compare_maps(aligned, reference.points, positions, max_range_m, options.spacing_m),
        entropy=map_entropy(map_points),
        positions=positions,
        max_range_m=max_range_m,
    )


def _along_trajectory(
    estimate: Estimate, metrics: TrajectoryMetrics | None, reference: ReferenceMap
) -> tuple[FloatArray | None, FloatArray]:
    """`T_reference_world` (4, 4) by the trajectories, and the sensor's positions (K, 3) in the map's world.

    The positions are the true ones where there are any: a lost trajectory would look at places it never was.
    """
    poses, method = estimate.poses, "se3" if metrics is None else metrics.alignment
    if reference.truth is not None and poses.stamps is not None:
        try:
            association = associate(Trajectory(poses.stamps, poses.T_world_lidar), reference.truth)
        except InputError:
            return None, poses.T_world_lidar[:, :3, 3]
        T_reference_world = align(association.estimate, association.reference, method)
        true_positions = association.reference.positions
    elif metrics is not None:
        T_reference_world, true_positions = metrics.T_reference_estimate, metrics.association.reference.positions
    else:
        return None, poses.T_world_lidar[:, :3, 3]
    return T_reference_world, transform_points(inverse(T_reference_world), true_positions)


def _align(
    map_points: FloatArray, reference: ReferenceMap, T_reference_world: FloatArray | None, options: MapOptions
) -> MapAlignment:
    by_trajectory = {} if T_reference_world is None else {TRAJECTORY: T_reference_world}
    refine = options.alignment != NONE if options.refine is None else options.refine
    as_given = {NONE: np.eye(4)}
    if options.alignment == AUTO:
        shares_world = reference.truth is not None and bool(by_trajectory)
        guesses = by_trajectory if shares_world else by_trajectory | as_given
        return align_map(map_points, reference.points, guesses, search=not shares_world, refine=refine)
    if options.alignment == GLOBAL:
        return align_map(map_points, reference.points, {}, search=True)
    if options.alignment == TRAJECTORY:
        if not by_trajectory:
            raise InputError("--map-alignment trajectory needs a true trajectory in the reference map's world")
        return align_map(map_points, reference.points, by_trajectory, refine=refine)
    if options.alignment == NONE:
        return align_map(map_points, reference.points, as_given, refine=refine)
    return align_map(
        map_points, reference.points, {"file": read_transform(Path(options.alignment))}, search=False, refine=refine
    )


def read_transform(path: Path) -> FloatArray:
    """A rigid transform (4, 4) from a text file of four rows of four numbers.

    Raises:
        InputError: the file holds anything else.
    """
    T = parse_numbers(path, columns=4)
    if T.shape != (4, 4) or not is_rigid(T, tolerance=1e-3):
        raise InputError(f"{path}: expected a rigid transform of four rows of four numbers, the last 0 0 0 1")
    return orthonormalize(T)
