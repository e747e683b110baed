"""Drift over segments of a given length: KITTI's, and that of short recordings.

The error of a segment is `inverse(T_first_last of the estimate) @ T_first_last of the reference`, without alignment.
Its translation depends on the lever arm of the poses on the vehicle, so both sides must be poses of one sensor.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, inverse, rotation_angle
from lidarslam.evaluation.trajectory.association import Association

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
