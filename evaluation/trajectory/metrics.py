"""Errors of a trajectory relative to a reference: absolute, relative, and drift over segments of a given length.

Drift is KITTI's, and that of short recordings. The error of a segment is `inverse(T_first_last of the estimate) @
T_first_last of the reference`, without alignment. Its translation depends on the lever arm of the poses on the vehicle,
so both sides must be poses of one sensor.
"""

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, inverse, rotation_angle
from lidarslam.core.plugins import PlugPoint, usable
from lidarslam.core.text import one_line
from lidarslam.core.trajectory import Trajectory
from lidarslam.evaluation.trajectory.alignment import (
    DEFAULT_MAX_GAP_S,
    DEFAULT_TOLERANCE_S,
    AlignmentMethod,
    Association,
    align,
    align_poses,
    associate,
)

KITTI_LENGTHS_M = (100, 200, 300, 400, 500, 600, 700, 800)
SHORT_LENGTHS_M = (5, 10, 25, 40, 60, 100)

_KITTI_STEP = 10
_KITTI_SPEEDS_MPS = range(2, 26, 2)
_KITTI_SPEED_WINDOW_MPS = 2.0


@dataclass(frozen=True)
class Drift:
    """Mean error over segments, relative to their length."""

    translation_percent: float  # translation error
    rotation_deg_per_m: float  # rotation error
    segments: int  # number of segments

    def to_json(self, per_m: int) -> dict[str, float]:
        """Both means, the rotation over `per_m` metres, as metrics.json names them."""
        return {
            "translation_percent": self.translation_percent,
            f"rotation_deg_per_{per_m}m": self.rotation_deg_per_m * per_m,
        }


@dataclass(frozen=True)
class KittiDrift:
    """Drift as the KITTI odometry development kit computes it."""

    overall: Drift  # the mean over all segments of all lengths, the figure of the KITTI table
    by_length: Mapping[int, Drift | None]  # metres -> drift; None where the trajectory is too short
    # m/s -> drift over segments driven within 2 m/s of it; None where there is no segment
    by_speed: Mapping[int, Drift | None]

    def to_json(self) -> dict[str, object]:
        """The overall figures, those by length and those by speed, as metrics.json names them."""
        by_length = {str(m): drift and drift.to_json(100) for m, drift in self.by_length.items()}
        by_speed = {str(mps): drift and drift.to_json(100) for mps, drift in self.by_speed.items()}
        return {**self.overall.to_json(100), "by_length": by_length, "by_speed": by_speed}


@dataclass(frozen=True, eq=False)
class SegmentErrors:
    """Errors of S segments, divided by their lengths."""

    lengths_m: FloatArray  # (S,) the length asked for
    speeds_mps: FloatArray  # (S,) the distance travelled over the time it took
    translation: FloatArray  # (S,) metres per metre
    rotation_rad_per_m: FloatArray  # (S,)

    def mean(self, chosen: NDArray[np.bool_] | slice = slice(None)) -> Drift | None:
        """The mean over the chosen segments, None when there are none."""
        translation, rotation = self.translation[chosen], self.rotation_rad_per_m[chosen]
        if not len(translation):
            return None
        return Drift(100.0 * float(translation.mean()), float(np.rad2deg(rotation.mean())), len(translation))


def segment_errors(
    association: Association, lengths_m: Iterable[float], step: int, over_travelled: bool = False
) -> SegmentErrors:
    """Errors over the segments that start at every `step`-th matched pose, of each of the lengths.

    A segment ends at the first pose that lies farther along the reference than the length asked for. The errors are
    divided by the length asked for, or, with `over_travelled`, by the distance travelled to that pose.
    """
    distances = association.reference.distances
    starts, asked = np.arange(0, len(distances), step), np.array([*lengths_m], dtype=np.float64)
    ends = np.searchsorted(distances, distances[starts] + asked[:, None], side="right")  # a row for each length
    row, column = np.nonzero(ends < len(distances))
    first, last, asked = starts[column], ends[row, column], asked[row]
    T_estimate = association.estimate.T_world_lidar
    T_reference = association.reference.T_world_lidar
    error = inverse(inverse(T_estimate[first]) @ T_estimate[last]) @ inverse(T_reference[first]) @ T_reference[last]
    travelled = distances[last] - distances[first]
    divisor = travelled if over_travelled else asked
    stamps = association.reference.stamps
    return SegmentErrors(
        lengths_m=asked,
        speeds_mps=travelled / (stamps[last] - stamps[first]),
        translation=np.linalg.norm(error[:, :3, 3], axis=1) / divisor,
        rotation_rad_per_m=rotation_angle(error) / divisor,
    )


def kitti_drift(association: Association) -> KittiDrift | None:
    """KITTI's drift: segments of 100 to 800 m from every tenth pose; None when the reference is shorter than 100 m.

    Geiger, Lenz, Urtasun, "Are we ready for Autonomous Driving?", CVPR 2012, as its development kit computes it,
    except that the speed is taken from the stamps, where the kit assumes ten scans a second.
    """
    errors = segment_errors(association, KITTI_LENGTHS_M, _KITTI_STEP)
    overall = errors.mean()
    if overall is None:
        return None
    by_length = {m: errors.mean(errors.lengths_m == m) for m in KITTI_LENGTHS_M}
    by_speed = {v: errors.mean(np.abs(errors.speeds_mps - v) < _KITTI_SPEED_WINDOW_MPS) for v in _KITTI_SPEEDS_MPS}
    return KittiDrift(overall, by_length, by_speed)


def short_drift(association: Association) -> dict[int, Drift | None]:
    """Drift over segments of 5 to 100 m: metres -> drift, None where the reference is too short.

    Unlike KITTI's, segments start at every pose, as a short recording has few, and errors are divided by the distance
    travelled, as a step of one metre is a large part of five.
    """
    errors = segment_errors(association, SHORT_LENGTHS_M, step=1, over_travelled=True)
    return {m: errors.mean(errors.lengths_m == m) for m in SHORT_LENGTHS_M}


logger = logging.getLogger(__name__)

METRICS = PlugPoint("metric")
"""Other packages' metrics: each takes the aligned estimate and the reference, and gives numbers by name."""
Metric = Callable[[Trajectory, Trajectory], Mapping[str, float]]

# Of the reference's spread: straight drives of two cars differ by 0.18 and more, a drive and its truth by 0.05 at most.
_UNRELATED_SHARE = 0.15
# Sensors that stay on one spot have no spread to compare with.
_NEGLIGIBLE_M = 0.05

# Orientations of one sensor differ by less, unless tracking was lost, when the positions differ, too.
_OTHER_FRAME_DEG = 45.0


@dataclass(frozen=True)
class TrajectoryErrors:
    """Errors in one number each; None where one cannot be computed."""

    length_m: float  # path length of the reference over the matched poses
    ate_rmse_m: float  # absolute trajectory error, the positions' root mean square distance after SE(3) alignment
    # root mean square angle between the orientations after alignment by positions and orientations: positions alone
    # leave the rotation about a straight path open
    ate_rotation_rmse_deg: float
    # relative pose error from one scan to the next; None when no two successive scans have a reference pose
    rpe_translation_rmse_m: float | None
    rpe_rotation_rmse_deg: float | None  # likewise for the rotation
    # distance between the last positions after the first poses are made to coincide; no smaller for a closed loop
    end_error_m: float


@dataclass(frozen=True, eq=False)
class TrajectoryMetrics:
    """All errors of a trajectory."""

    association: Association  # the pairs of poses that were compared
    T_reference_estimate: FloatArray  # (4, 4) the alignment of the ATE, by the positions
    T_reference_estimate_joint: FloatArray  # (4, 4) that of the rotations, by positions and orientations
    errors: TrajectoryErrors  # absolute and relative errors
    kitti: KittiDrift | None  # KITTI's drift; None under 100 m
    segments: Mapping[int, Drift | None]  # metres -> drift over short segments; None where the reference is too short
    alignment: AlignmentMethod = "se3"  # how the alignment was found
    # other packages' metrics by name; None where one cannot be computed
    plugins: Mapping[str, Mapping[str, float | None] | None] = field(default_factory=dict)

    def absolute_errors(self) -> tuple[FloatArray, FloatArray]:
        """Distance (M,) in metres and angle (M,) in radians of every pose, as in the ATE."""
        return absolute_errors(self.association, self.T_reference_estimate, self.T_reference_estimate_joint)

    def deviations(self) -> tuple[FloatArray, FloatArray]:
        """Poses of the aligned estimate in the frame of the reference's LiDAR (x forward, y left, z up).

        Translation (M, 3) in metres and roll, pitch, yaw (M, 3) in degrees, R = Rz(yaw) Ry(pitch) Rx(roll).
        """
        T, T_true_world = self.association.estimate.T_world_lidar, inverse(self.association.reference.T_world_lidar)
        R = (T_true_world @ self.T_reference_estimate_joint @ T)[:, :3, :3]
        # At a pitch of 90 degrees roll and yaw are ambiguous; atan2 gives numbers without SciPy's warning.
        pitch = np.arcsin(np.clip(-R[:, 2, 0], -1.0, 1.0))
        roll, yaw = np.arctan2(R[:, 2, 1], R[:, 2, 2]), np.arctan2(R[:, 1, 0], R[:, 0, 0])
        translations_m = (T_true_world @ self.T_reference_estimate @ T)[:, :3, 3]
        return translations_m, np.rad2deg(np.stack([roll, pitch, yaw], axis=-1))

    def to_json(self, map_metrics: Mapping[str, object] | None = None) -> dict[str, object]:
        """The content of metrics.json: these errors, and those of a map."""
        return {
            "association": self.association.to_json(),
            "trajectory": asdict(self.errors),
            "kitti": self.kitti and self.kitti.to_json(),
            "segments": {str(m): drift and drift.to_json(10) for m, drift in self.segments.items()},
            "map": map_metrics,
            **({"plugins": dict(self.plugins)} if self.plugins else {}),
        }

    def plugin_lines(self) -> Iterator[tuple[str, str]]:
        """Names of other packages' metrics, and their numbers in words."""
        for name, values in self.plugins.items():
            numbers = (f"{key} {'-' if value is None else f'{value:.6g}'}" for key, value in (values or {}).items())
            yield name, ", ".join(numbers) if values else "could not be computed"


def evaluate_trajectory(
    estimate: Trajectory,
    reference: Trajectory,
    tolerance_s: float = DEFAULT_TOLERANCE_S,
    max_gap_s: float = DEFAULT_MAX_GAP_S,
    alignment: AlignmentMethod = "se3",
) -> TrajectoryMetrics:
    """Compare an estimate with a reference, both poses of the LiDAR; the worlds may differ, the scale may not.

    The two are matched in time by `associate`, which explains `tolerance_s` and `max_gap_s`. The `alignment`, which
    `align` explains, concerns the absolute errors only.
    """
    association = associate(estimate, reference, tolerance_s, max_gap_s)
    pair = association.estimate, association.reference
    T_reference_estimate = align(*pair, alignment)
    T_reference_estimate_joint = align_poses(*pair, T_reference_estimate, alignment)
    return TrajectoryMetrics(
        association=association,
        T_reference_estimate=T_reference_estimate,
        T_reference_estimate_joint=T_reference_estimate_joint,
        errors=trajectory_errors(association, T_reference_estimate, T_reference_estimate_joint),
        kitti=kitti_drift(association),
        segments=short_drift(association),
        alignment=alignment,
        plugins={
            name: _computed(name, metric, pair[0].transformed(T_reference_estimate), pair[1])
            for name, metric in usable(METRICS, Callable).items()
        },
    )


def _computed(
    name: str, metric: Metric, estimate: Trajectory, reference: Trajectory
) -> Mapping[str, float | None] | None:
    """The numbers of another package's metric, None where they are not finite; None where it fails."""
    try:
        values = {str(key): float(value) for key, value in metric(estimate, reference).items()}
    except Exception as error:  # another package's code: other figures are kept
        logger.warning("the metric %s could not be computed: %s: %s", name, type(error).__name__, one_line(str(error)))
        return None
    return {key: value if math.isfinite(value) else None for key, value in values.items()}


def metrics_json(trajectory: TrajectoryMetrics | None, map_metrics: Mapping[str, object] | None) -> dict[str, object]:
    """The content of metrics.json: a trajectory's errors and a map's, None where there is no reference for it."""
    if trajectory is not None:
        return trajectory.to_json(map_metrics)
    return {**dict.fromkeys(("association", "trajectory", "kitti", "segments")), "map": map_metrics}


def trajectory_errors(
    association: Association, T_reference_estimate: FloatArray, T_reference_estimate_joint: FloatArray
) -> TrajectoryErrors:
    """The absolute errors after the given alignments (4, 4), and the relative ones, which need none."""
    distances_m, angles_rad = absolute_errors(association, T_reference_estimate, T_reference_estimate_joint)
    step_distances_m, step_angles_rad = relative_errors(association)
    at_start = align(association.estimate, association.reference, "first_pose")
    end = at_start @ association.estimate.T_world_lidar[-1]
    return TrajectoryErrors(
        length_m=association.reference.length_m,
        ate_rmse_m=_rms(distances_m),
        ate_rotation_rmse_deg=float(np.rad2deg(_rms(angles_rad))),
        rpe_translation_rmse_m=_rms(step_distances_m) if len(step_distances_m) else None,
        rpe_rotation_rmse_deg=float(np.rad2deg(_rms(step_angles_rad))) if len(step_angles_rad) else None,
        end_error_m=float(np.linalg.norm(end[:3, 3] - association.reference.positions[-1])),
    )


def absolute_errors(
    association: Association, T_reference_estimate: FloatArray, T_orientations: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Distance (M,) in metres and angle (M,) in radians between each aligned pose and its reference.

    Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012. The orientations may have an
    alignment (4, 4) of their own.
    """
    T, T_reference = association.estimate.T_world_lidar, association.reference.T_world_lidar
    distances_m, angles_rad = _differences(T_reference_estimate @ T, T_reference)
    return distances_m, angles_rad if T_orientations is None else _differences(T_orientations @ T, T_reference)[1]


def relative_errors(association: Association) -> tuple[FloatArray, FloatArray]:
    """Distance in metres and angle in radians between the motions `T_prev_curr` of both, for successive scans.

    A pair is left out when a scan between the two has no reference. Sturm et al., IROS 2012.
    """
    successive = np.diff(association.rows) == 1
    estimate = association.estimate.relative_motions()[successive]
    return _differences(estimate, association.reference.relative_motions()[successive])


def disagreement(metrics: TrajectoryMetrics) -> str | None:
    """Warning that the two trajectories are not of one drive, so that their errors mean nothing; None if they agree.

    They agree while the ATE is a small part of the reference's spread, the root mean square distance of its positions
    from their mean, and the orientations differ by far less than a right angle.
    """
    reference, errors = metrics.association.reference, metrics.errors
    offsets = reference.positions - reference.positions.mean(axis=0)
    spread_m = float(np.sqrt(np.mean(np.sum(offsets**2, axis=1))))
    if errors.ate_rmse_m > max(_UNRELATED_SHARE * spread_m, _NEGLIGIBLE_M):
        return (
            f"the trajectory does not follow its reference: the ATE is {errors.ate_rmse_m:.3g} m, the spread of the"
            f" reference {spread_m:.3g} m; it is {metrics.association.estimate.length_m:.3g} m long, the reference"
            f" {reference.length_m:.3g} m; it drifts, tracking was lost, or the reference is in another unit, or of"
            " another recording or sensor"
        )
    if errors.ate_rotation_rmse_deg >= _OTHER_FRAME_DEG:
        return (
            f"the positions follow the reference, but the orientations differ by {errors.ate_rotation_rmse_deg:.3g}"
            " deg: the reference is of another frame than the LiDAR's, or its quaternions begin with qw, which ends"
            " TUM's"
        )
    return None


def _differences(T_a: FloatArray, T_b: FloatArray) -> tuple[FloatArray, FloatArray]:
    distance = np.linalg.norm(T_a[:, :3, 3] - T_b[:, :3, 3], axis=1)
    return np.asarray(distance, dtype=np.float64), rotation_angle(inverse(T_a) @ T_b)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
