"""Whether the points of a recording without times get them from their azimuth."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.datasets.config import TimeReference
from lidarslam.datasets.times.azimuth import SweepOrder, are_as_measured, offsets_from_order, sweep_order
from lidarslam.datasets.times.point_time_inference import LearnedTime

# No sensor turns more slowly; scans farther apart leave sweeps out between them.
_LONGEST_SWEEP_S = 0.25
# Pairs of consecutive scans that are compared, spread over the recording.
_PAIRS = 40

_USED = "The points are in the order of one turn, and their times follow from the azimuth."
_NOT_USED = (
    "The points have no times, and the seams of the sweeps are closed as in motion compensated ones, or sweeps are"
    " missing between; none are made from the azimuth."
)
_OFFERED = (
    "The points have no times but are in the order of one turn; whether the sweeps are as measured or motion"
    " compensated does not show. If they are as measured, --set reader.time_reference=azimuth gives the points times."
)
_UNORDERED = "The points have no times, and are not in the order of one turn, from which times could follow."
_NO_ORDER = "Times were to follow from the azimuth, but the points are not in the order of one turn."
_TOO_SLOW = "Times were to follow from the azimuth, but the scans lie farther apart than a sweep lasts."
_NO_TIMES = (
    "; the scans are taken as measured at one instant, or motion compensated. If they are neither, name another field"
    " with --set reader.time_field=NAME, or give its unit with reader.time_unit; --set reader.time_reference=none"
    " accepts it."
)


class Sweep(NamedTuple):
    """A scan as stored."""

    points: FloatArray  # (N, 3), places without a return included
    rings: NDArray[np.generic] | None  # (N,)


@dataclass(frozen=True)
class AzimuthTiming:
    """Whether points get their times from the azimuth, and what there is to say of it."""

    period_s: float | None = None  # the duration of a sweep; None: the points get no times
    note: str | None = None  # a fact for the user
    warning: str | None = None  # what is missing, and what to set

    def offsets(self, sweep: Sweep) -> FloatArray | None:
        """Seconds (N,) from the sweep's first point; None without times."""
        return None if self.period_s is None else offsets_from_order(sweep.points, sweep.rings, self.period_s)


def time_warnings(learned: LearnedTime, azimuth: AzimuthTiming) -> tuple[str, ...]:
    """A line on the time field that was not as it should be, with what became of the times, and one on the azimuth."""
    fault = learned.warning
    if fault is not None and learned.model is None:
        without = "." if azimuth.warning is not None else _NO_TIMES
        fault += without if azimuth.period_s is None else "; the times follow from the azimuth instead."
    return tuple(warning for warning in (fault, azimuth.warning) if warning is not None)


def pair_starts(scans: int) -> list[int]:
    """Indices, spread over a recording of so many scans, of the first scan of each pair that is compared."""
    return sorted({int(index) for index in np.linspace(0, max(0, scans - 2), _PAIRS)})


def infer_azimuth_timing(
    runs: Iterable[Iterable[Sweep]], period_s: float | None, reference: TimeReference
) -> AzimuthTiming:
    """Decide by runs of consecutive scans, where the recording has no times of its own.

    Args:
        runs: two or more consecutive scans each; read only as far as needed.
        period_s: seconds between scans; None for a single one.
        reference: "azimuth" does not question that sweeps are as measured; other than "auto", there is nothing to do.
    """
    if reference not in ("auto", "azimuth") or period_s is None:
        return AzimuthTiming()
    orders = ([sweep_order(*sweep) for sweep in run] for run in runs)
    if reference == "azimuth":
        return _as_asked(orders, period_s)
    if period_s >= _LONGEST_SWEEP_S:
        return AzimuthTiming()
    if not (pairs := list(_ordered_pairs(orders))):
        return AzimuthTiming(note=_UNORDERED)
    decision = are_as_measured(pairs)
    if decision is None:
        return AzimuthTiming(warning=_OFFERED)
    return AzimuthTiming(period_s, note=_USED) if decision else AzimuthTiming(note=_NOT_USED)


def _as_asked(runs: Iterable[list[SweepOrder | None]], period_s: float) -> AzimuthTiming:
    if all(order is None for run in runs for order in run):
        return AzimuthTiming(warning=_NO_ORDER)
    return AzimuthTiming(period_s, note=_USED) if period_s < _LONGEST_SWEEP_S else AzimuthTiming(warning=_TOO_SLOW)


def _ordered_pairs(runs: Iterable[list[SweepOrder | None]]) -> Iterator[tuple[SweepOrder, SweepOrder]]:
    """Consecutive sweeps that are in the order of firing; none where the first sweeps are not."""
    for number, run in enumerate(runs):
        if number == 0 and all(order is None for order in run):
            return
        for sweep, following in pairwise(run):
            if sweep is not None and following is not None:
                yield sweep, following
