"""Comparison of a map with a reference map: alignment, errors, entropy."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidarslam.assessment.inputs import Estimate, ReferenceMap
from lidarslam.core.errors import ConfigError, InputError
from lidarslam.core.geometry import FloatArray, inverse, transform_points
from lidarslam.core.trajectory import Trajectory, read_transform
from lidarslam.evaluation.comparison.comparison import MapErrors
from lidarslam.evaluation.map.alignment import GLOBAL, MapAlignment, align_map
from lidarslam.evaluation.map.entropy import MapEntropy, map_entropy
from lidarslam.evaluation.map.metrics import DEFAULT_SPACING_M, F_SCORE_THRESHOLDS_M, MapComparison, compare_maps
from lidarslam.evaluation.trajectory.alignment import align, align_poses
from lidarslam.evaluation.trajectory.association import common_instants
from lidarslam.evaluation.trajectory.metrics import TrajectoryMetrics

_DRAWN_POINTS = 200_000


@dataclass(frozen=True)
class MapOptions:
    """Options of the comparison of maps."""

    # initial `T_reference_map`. "trajectory": the alignment of the trajectory with one in the reference map's world;
    # "none": the identity; "global": global registration; or the name of a text file with the 4x4 matrix. "auto": the
    # trajectory where it is known to be in the reference map's world, else the first of trajectory, none and global
    # that fits.
    alignment: str = "auto"
    refine: bool | None = None  # whether ICP follows; None: unless the alignment is "none"
    spacing_m: float = DEFAULT_SPACING_M  # edge of the cells that both clouds are thinned to one point in
    max_range_m: float | None = None  # range of the sensor; None: that of the run's map

    def __post_init__(self) -> None:
        if self.alignment == GLOBAL and self.refine is False:
            raise ConfigError("a global search is good to a metre only; let --refine follow it")


@dataclass(frozen=True, eq=False)
class MapEvaluation:
    """Errors of a map."""

    reference: str  # description of the reference map
    alignment: MapAlignment  # of the map with it
    comparison: MapComparison  # the errors, in numbers and point by point
    entropy: MapEntropy | None  # of the map by itself; None when it is too sparse
    positions: FloatArray  # (K, 3) of the sensor, in the reference's frame
    max_range_m: float  # range of the sensor

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
        """Reasons not to trust the figures."""
        alignment, gap_m = self.alignment, self.comparison.map_gap_m
        if not alignment.is_trustworthy:
            yield (
                f"only {100.0 * alignment.fitness:.0f} % of the map lies within {alignment.inlier_m:g} m of the"
                " reference: the map is bent, or its alignment is wrong; look at it with --errors FILE.ply"
            )
        if gap_m is not None and gap_m > F_SCORE_THRESHOLDS_M[0]:
            yield (
                f"the map's points are {gap_m:.2f} m apart, which limits completeness and the F-score at"
                f" {F_SCORE_THRESHOLDS_M[0]:g} m; run again with --set global_map.voxel_size_m=0.05"
            )


def evaluate_map(
    estimate: Estimate, metrics: TrajectoryMetrics | None, reference: ReferenceMap, options: MapOptions | None = None
) -> MapEvaluation:
    """Compare the map of an estimate, in the world of its poses, with a reference map.

    The metrics are those of its trajectory, None when that has no reference.
    """
    options = options or MapOptions()
    points = estimate.map_points()
    T_reference_world, positions = _along_trajectory(estimate, metrics, reference)
    alignment = _align(points, reference, T_reference_world, options)
    max_range_m = options.max_range_m or estimate.config.global_map.max_range_m
    positions = transform_points(alignment.T_reference_map, positions)
    aligned = transform_points(alignment.T_reference_map, points)
    comparison = compare_maps(aligned, reference.points, positions, max_range_m, options.spacing_m)
    return MapEvaluation(reference.label, alignment, comparison, map_entropy(points), positions, max_range_m)


def _along_trajectory(
    estimate: Estimate, metrics: TrajectoryMetrics | None, reference: ReferenceMap
) -> tuple[FloatArray | None, FloatArray]:
    """`T_reference_world` (4, 4) by the trajectories, and the sensor's positions (K, 3) in the map's world.

    The positions are the true ones where there are any, as those of a lost trajectory are wrong.
    """
    poses, method = estimate.poses, "se3" if metrics is None else metrics.alignment
    association = None if metrics is None else metrics.association
    T_reference_world = None if metrics is None else metrics.T_reference_estimate_joint
    if reference.truth is not None and poses.stamps is not None:
        association = common_instants(Trajectory(poses.stamps, poses.T_world_lidar), reference.truth)
        if association is not None:
            pair = association.estimate, association.reference
            T_reference_world = align_poses(*pair, align(*pair, method), method)
    if association is None or T_reference_world is None:
        return None, poses.T_world_lidar[:, :3, 3]
    return T_reference_world, transform_points(inverse(T_reference_world), association.reference.positions)


def _align(
    points: FloatArray, reference: ReferenceMap, T_reference_world: FloatArray | None, options: MapOptions
) -> MapAlignment:
    by_trajectory = {} if T_reference_world is None else {"trajectory": T_reference_world}
    as_given, search = {"none": np.eye(4)}, options.alignment == GLOBAL
    match options.alignment:
        case "auto":
            search = reference.truth is None or not by_trajectory
            guesses = by_trajectory | as_given if search else by_trajectory
        case "global":
            guesses = {}
        case "trajectory":
            if not by_trajectory:
                raise InputError("--map-alignment trajectory needs a true trajectory in the reference map's world")
            guesses = by_trajectory
        case "none":
            guesses = as_given
        case file:
            guesses = {"file": read_transform(Path(file))}
    refine = options.alignment != "none" if options.refine is None else options.refine
    return align_map(points, reference.points, guesses, search, refine)
