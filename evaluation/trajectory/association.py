"""Association of an estimate with a reference in time."""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.text import count
from lidarslam.core.trajectory import Trajectory

# Interpolation over half a second at constant velocity errs by a * 0.5^2 / 8 at most, 6 cm when braking at 2 m/s^2.
DEFAULT_MAX_GAP_S = 0.5
DEFAULT_TOLERANCE_S = 0.02

_FEWEST_MATCHES = 3


@dataclass(frozen=True, eq=False)
class Association:
    """Pairs of poses of one instant, M of them."""

    estimate: Trajectory  # the matched poses of the estimate, `T_world_lidar` in the estimate's world
    reference: Trajectory  # the reference at the same M stamps, `T_world_lidar` in the reference's world
    rows: NDArray[np.intp]  # (M,) increasing, of the matched poses in the whole estimate
    estimate_count: int  # poses of the whole estimate
    reference_count: int  # poses of the whole reference

    def __len__(self) -> int:
        return len(self.rows)

    def to_json(self) -> dict[str, int]:
        """The counts, as metrics.json names them."""
        return {"matched": len(self), "estimate": self.estimate_count, "reference": self.reference_count}


def associate(
    estimate: Trajectory,
    reference: Trajectory,
    tolerance_s: float = DEFAULT_TOLERANCE_S,
    max_gap_s: float = DEFAULT_MAX_GAP_S,
) -> Association:
    """The reference pose at the instant of each pose of the estimate.

    The reference is interpolated at constant body velocity. A stamp is matched when the reference poses around it are
    at most `max_gap_s` apart, or when one of them is at most `tolerance_s` away; so a stamp is extrapolated by
    `tolerance_s` at most. At equal stamps the reference pose is taken as it is, to the last bit.
    """
    matched = _is_matched(estimate.stamps, reference.stamps, tolerance_s, max_gap_s)
    rows = np.flatnonzero(matched)
    if len(rows) < _FEWEST_MATCHES or len(reference) < 2:
        raise InputError(_explain(estimate, reference, len(rows), tolerance_s, max_gap_s))
    stamps = estimate.stamps[rows]
    at_stamps = Trajectory(stamps, _reference_at(reference, stamps))
    return Association(estimate.select(rows), at_stamps, rows, len(estimate), len(reference))


def common_instants(estimate: Trajectory, reference: Trajectory) -> Association | None:
    """As `associate`; None where they have too few instants in common, as trajectories of different recordings."""
    with suppress(InputError):
        return associate(estimate, reference)
    return None


def _is_matched(stamps: FloatArray, reference: FloatArray, tolerance_s: float, max_gap_s: float) -> NDArray[np.bool_]:
    if not len(reference):
        return np.zeros(len(stamps), dtype=np.bool_)
    right = np.searchsorted(reference, stamps, side="left")
    before = reference[np.clip(right - 1, 0, len(reference) - 1)]
    after = reference[np.clip(right, 0, len(reference) - 1)]
    between = (before <= stamps) & (stamps <= after) & (after - before <= max_gap_s)
    nearest = np.minimum(np.abs(stamps - before), np.abs(after - stamps))
    return np.asarray(between | (nearest <= tolerance_s), dtype=np.bool_)


def _reference_at(reference: Trajectory, stamps: FloatArray) -> FloatArray:
    times = reference.stamps
    # Two reference poses a microsecond apart do not determine the velocity: extrapolate by one step at most.
    reached = np.clip(stamps, 2 * times[0] - times[1], 2 * times[-1] - times[-2])
    T_world_lidar = reference.at(reached, extrapolation_s=np.inf)
    candidates = np.clip(np.searchsorted(times, stamps), 0, len(times) - 1)
    equal = times[candidates] == stamps
    T_world_lidar[equal] = reference.T_world_lidar[candidates[equal]]
    return T_world_lidar


def _explain(estimate: Trajectory, reference: Trajectory, matched: int, tolerance_s: float, max_gap_s: float) -> str:
    spans = [
        f"{count(len(of), 'pose')}{f' from {of.stamps[0]:.3f} to {of.stamps[-1]:.3f} s' if len(of) else ''}"
        for of in (estimate, reference)
    ]
    cause = "correct the clock or the unit of the stamps, or check that the reference belongs to this recording"
    a, b = estimate.stamps, reference.stamps
    if len(a) < _FEWEST_MATCHES or len(b) < 2:
        cause = "one of them is too short; check that both files are complete"
    elif max(a[0], b[0]) <= min(a[-1], b[-1]) + tolerance_s:
        cause = f"poses more than {max_gap_s:g} s apart are not bridged; use a denser reference or allow a larger gap"
    return (
        f"expected {_FEWEST_MATCHES} or more poses with a reference pose at the same instant, found {matched}:"
        f" the estimate has {spans[0]}, the reference {spans[1]}; {cause}"
    )
