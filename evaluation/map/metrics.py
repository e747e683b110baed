"""Errors of a map relative to a reference map: accuracy, completeness, F-score, coverage, deviation.

Both clouds are first thinned to one point per cell, so that density has no weight. Distances are from point to nearest
point; for a flawless map they are therefore about half of the spacing, not 0.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import median_gap_m
from lidarslam.core.thinning import first_per_cell

F_SCORE_THRESHOLDS_M = (0.1, 0.2, 0.5)
SUBT_TOLERANCES_M = (1.0,)
DEFAULT_SPACING_M = 0.05
# Accuracy is that of the map in the reference's bounding box, grown by this much on every side.
BOX_MARGIN_M = 1.0

_GAP_SAMPLES = 10_000


@dataclass(frozen=True)
class MapMetrics:
    """Errors of a map; None where one cannot be computed."""

    accuracy_mean_m: float | None  # mean distance of the map's points to the reference
    completeness_mean_m: float | None  # mean distance of the reference's points to the map
    chamfer_m: float | None  # the mean of the two
    # threshold in metres -> harmonic mean of the share of the map's points that are that close to the reference, and of
    # the reference's points that close to the map. Knapitsch et al., "Tanks and Temples", TOG 2017.
    f_score_percent: Mapping[float, float | None]
    # tolerance in metres -> share of the reference's points that close to the map
    coverage_percent: Mapping[float, float | None]
    # tolerance in metres -> share of the map's points farther from the reference
    deviation_percent: Mapping[float, float | None]

    def to_json(self) -> dict[str, object]:
        """The errors, as metrics.json names them."""
        return {
            name: {str(float(m)): share for m, share in value.items()} if isinstance(value, Mapping) else value
            for name, value in vars(self).items()
        }


@dataclass(frozen=True, eq=False)
class CloudErrors:
    """Points of one cloud and their distances from the other."""

    points: FloatArray  # (N, 3) the thinned cloud, in the reference's frame
    distances_m: FloatArray  # (N,) to the nearest point of the other
    considered: NDArray[np.bool_] | None = None  # (N,) whether the point lies where both clouds can have one; None: all

    @property
    def considered_m(self) -> FloatArray:
        """Distances of the points that are considered."""
        return self.distances_m if self.considered is None else self.distances_m[self.considered]

    def thinned(self, most: int) -> "CloudErrors":
        """At most so many of the points, for drawing."""
        step = max(1, -(-len(self.points) // most))
        return CloudErrors(self.points[::step], self.distances_m[::step])


@dataclass(frozen=True, eq=False)
class MapComparison:
    """Errors of a map and of its reference."""

    metrics: MapMetrics  # the errors in one number each
    map_errors: CloudErrors  # the map's points and their distances to the reference
    reference_errors: CloudErrors  # the reference's points and their distances to the map
    # median distance between neighbouring points of the thinned map; None for fewer than two points
    map_gap_m: float | None


def compare_maps(
    map_points: FloatArray,
    reference_points: FloatArray,
    positions: FloatArray | None = None,
    max_range_m: float = np.inf,
    spacing_m: float = DEFAULT_SPACING_M,
) -> MapComparison:
    """Compare an aligned map (N, 3) with a reference (M, 3).

    Accuracy and the precision of the F-score are of the map's points inside the reference's bounding box grown by a
    metre; completeness and the recall of the reference's points within the sensor's range of the path. Coverage and
    deviation are of all points, as in the map analysis of the DARPA SubT Challenge, so that outliers beyond the box
    count.

    All are in the reference's frame, the positions (K, 3) of the sensor too; both clouds are thinned to cells of
    `spacing_m`.
    """
    origin = reference_points.mean(axis=0) if len(reference_points) else np.zeros(3)
    mapped, reference = (first_per_cell(cloud - origin, spacing_m) for cloud in (map_points, reference_points))
    in_range = np.ones(len(reference), dtype=np.bool_)
    if positions is not None and np.isfinite(max_range_m):
        in_range = np.isfinite(_distances(reference, positions - origin, max_range_m))
    map_errors = CloudErrors(mapped + origin, _distances(mapped, reference), _in_box(mapped, reference))
    reference_errors = CloudErrors(reference + origin, _distances(reference, mapped), in_range)
    metrics = _metrics(map_errors, reference_errors)
    return MapComparison(metrics, map_errors, reference_errors, median_gap_m(mapped, _GAP_SAMPLES))


def _metrics(mapped: CloudErrors, reference: CloudErrors) -> MapMetrics:
    # A side without points leaves the other side's distances infinite: nothing can be computed then.
    empty = not len(mapped.points) or not len(reference.points)
    accuracy, completeness = (
        None if empty or not len(of.considered_m) else float(of.considered_m.mean()) for of in (mapped, reference)
    )
    chamfer = None if accuracy is None or completeness is None else 0.5 * (accuracy + completeness)
    return MapMetrics(
        accuracy_mean_m=accuracy,
        completeness_mean_m=completeness,
        chamfer_m=chamfer,
        f_score_percent={m: None if chamfer is None else _f_score(mapped, reference, m) for m in F_SCORE_THRESHOLDS_M},
        coverage_percent={m: None if empty else _percent(reference, m) for m in SUBT_TOLERANCES_M},
        deviation_percent={m: None if empty else 100.0 - _percent(mapped, m) for m in SUBT_TOLERANCES_M},
    )


def _f_score(mapped: CloudErrors, reference: CloudErrors, threshold_m: float) -> float:
    precision, recall = (float(np.mean(of.considered_m <= threshold_m)) for of in (mapped, reference))
    return 200.0 * precision * recall / (precision + recall) if precision + recall else 0.0


def _percent(errors: CloudErrors, tolerance_m: float) -> float:
    return 100.0 * float(np.mean(errors.distances_m <= tolerance_m))


def _distances(points: FloatArray, others: FloatArray, bound_m: float = np.inf) -> FloatArray:
    """Distance (N,) of each point to the nearest of the others; inf beyond the bound, and when there are none."""
    if not len(points) or not len(others):
        return np.full(len(points), np.inf)
    # Without balancing and shrinking a tree is built several times faster, and thinned points need neither.
    tree = cKDTree(others, balanced_tree=False, compact_nodes=False)
    distances, _ = tree.query(points, distance_upper_bound=bound_m, workers=-1)
    return np.asarray(distances, dtype=np.float64)


def _in_box(points: FloatArray, reference: FloatArray) -> NDArray[np.bool_]:
    if not len(reference):
        return np.zeros(len(points), dtype=np.bool_)
    low, high = reference.min(axis=0) - BOX_MARGIN_M, reference.max(axis=0) + BOX_MARGIN_M
    return np.asarray(((points >= low) & (points <= high)).all(axis=1), dtype=np.bool_)
