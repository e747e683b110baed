"""When each point of a sweep was measured: which field says so, in which unit, counted from where.

Drivers agree on nothing here, so unit and reference are inferred from the values of one scan and then applied to all.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.datasets.config import TimeReference, TimeUnit
from lidarslam.datasets.value_spread import ValueSpread, value_spread

logger = logging.getLogger(__name__)

# In the order of preference, should a cloud have several; compared without regard to case.
TIME_FIELD_NAMES: tuple[str, ...] = (
    "t",
    "time",
    "timestamp",
    "timestamps",
    "stamps",
    "offset_time",
    "time_offset",
    "time_stamp",
)
RING_FIELD_NAMES: tuple[str, ...] = ("ring", "channel", "line", "laser_id", "laser", "ring_id", "beam_id", "beam")

UNITS_PER_SECOND = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}

# A sweep and its stamp are closer than this; what lies farther away is on another clock, or is no time at all.
CLOCK_LIMIT_S = 1.0
# Sweeps last 0.02 to 0.3 s. The limits leave room for partial ones and are less than one unit (1000) apart.
_SWEEP_S, _SHORTEST_SWEEP_S, _LONGEST_SWEEP_S = 0.1, 0.005, 1.0
# The same relative to the time between scans, where that is known and itself credible.
_SHORTEST_OF_PERIOD, _LONGEST_OF_PERIOD = 0.05, 1.5
_CREDIBLE_PERIOD_S = (1e-3, 2.0)
# Coarser times than this part of the sweep do not tell the points apart.
_COARSEST_OF_SWEEP = 0.1
_MEDIAN_SAMPLE = 2048


def _first_listed(names: Sequence[str], wanted: tuple[str, ...]) -> str | None:
    present = {name.lower(): name for name in reversed(names)}
    return next((present[name] for name in wanted if name in present), None)


def find_time_field(names: Sequence[str], wanted: str | None = None) -> str | None:
    """The field with the per-point time: the wanted one, else the first of `TIME_FIELD_NAMES`; None without any.

    Raises:
        InputError: the wanted field is not among the names.
    """
    if wanted is None:
        return _first_listed(names, TIME_FIELD_NAMES)
    if wanted not in names:
        raise InputError(f"the points have no time field {wanted!r}; their fields are: {', '.join(names)}")
    return wanted


def find_ring_field(names: Sequence[str]) -> str | None:
    """The field with the number of the laser, the first of `RING_FIELD_NAMES`; None without any."""
    return _first_listed(names, RING_FIELD_NAMES)


@dataclass(frozen=True)
class PointTimeModel:
    """How to turn the raw values of a time field into seconds from the scan's stamp.

    Attributes:
        field: name of the field.
        unit: "s", "ms", "us" or "ns".
        reference: "relative" (the values count from the stamp) or "absolute" (they read a clock).
    """

    field: str
    unit: str
    reference: str

    def offsets(self, values: NDArray[np.generic], stamp: float) -> FloatArray:
        """Seconds from the stamp, float64, of the shape of the values (N,).

        Exact to a nanosecond for integers, and to the resolution of the values for floats. Times more than a second
        from the stamp come from a clock that is not the stamp's: they are shifted so that the earliest point gets
        offset zero. Single times more than a second from the rest are NaN, as `Scan.from_raw` expects of bad points.
        """
        middle = self._middle(values)
        if middle is None:
            return np.full(values.shape, np.nan)
        zero = self._zero(stamp)
        same_clock = self._is_near(middle, zero)
        if not same_clock:
            zero = middle
        offsets = self._seconds_since(zero, values)
        astray = ~(np.abs(offsets - float((middle - zero) / UNITS_PER_SECOND[self.unit])) <= CLOCK_LIMIT_S)
        if astray.any():
            offsets[astray] = np.nan
        return offsets if same_clock else offsets - np.nanmin(offsets)

    def shares_clock(self, values: NDArray[np.generic], stamp: float) -> bool:
        """Whether the times and the stamp are readings of one clock, so that `offsets` need not shift them."""
        middle = self._middle(values)
        return middle is None or self._is_near(middle, self._zero(stamp))

    def _zero(self, stamp: float) -> Fraction:
        """What the field reads at the stamp."""
        return Fraction(stamp) * UNITS_PER_SECOND[self.unit] if self.reference == "absolute" else Fraction(0)

    def _is_near(self, reading: Fraction, other: Fraction) -> bool:
        return abs(reading - other) <= CLOCK_LIMIT_S * UNITS_PER_SECOND[self.unit]

    def _middle(self, values: NDArray[np.generic]) -> Fraction | None:
        """About the median, one of the values; from a sample, because it is asked for every scan."""
        sample = values[:: max(1, len(values) // _MEDIAN_SAMPLE)]
        sample = sample[np.isfinite(sample)]
        if self.reference == "absolute" and (set_times := sample[sample != 0]).size:
            sample = set_times  # a clock that reads zero is a missing return
        return Fraction(np.sort(sample)[len(sample) // 2].item()) if len(sample) else None

    def _seconds_since(self, zero: Fraction, values: NDArray[np.generic]) -> FloatArray:
        # Differences to the nearest reading are exact in the values' own type and unit, and so is what that
        # reading leaves over; converted to seconds first, an epoch would have lost its nanoseconds.
        per_second = UNITS_PER_SECOND[self.unit]
        if values.dtype.kind in "iu":
            nearest = round(zero)
            wrapped = np.array(nearest % 2**64, dtype=np.uint64)  # modulo 2^64 any integers may be subtracted
            difference = (values.astype(np.uint64) - wrapped).astype(np.int64)
            return np.asarray(difference / per_second + float((nearest - zero) / per_second))
        rounded = float(zero)
        with np.errstate(invalid="ignore", over="ignore"):  # damaged bytes may be any number
            seconds = (values.astype(np.float64) - rounded) / per_second
        return np.asarray(seconds + float((Fraction(rounded) - zero) / per_second))


def _unit_by_clock(spread: ValueSpread, stamp: float | None, units: Sequence[str]) -> str | None:
    """The unit in which the values read what the stamp reads."""
    if stamp is None or abs(stamp) <= 2 * CLOCK_LIMIT_S:  # too close to zero to tell from relative times
        return None
    for unit in units:
        per_second = UNITS_PER_SECOND[unit]
        if abs(spread.middle / per_second - stamp) <= CLOCK_LIMIT_S and spread.span / per_second <= _LONGEST_SWEEP_S:
            return unit
    return None


def _unit_by_span(spread: ValueSpread, units: Sequence[str], period_s: float | None) -> str | None:
    """The unit in which the values span a sweep."""
    spans = {unit: spread.span / UNITS_PER_SECOND[unit] for unit in units}
    if period_s is not None and _CREDIBLE_PERIOD_S[0] <= period_s <= _CREDIBLE_PERIOD_S[1]:
        for unit, span in spans.items():
            if _SHORTEST_OF_PERIOD * period_s <= span <= _LONGEST_OF_PERIOD * period_s:
                return unit
    fitting = [unit for unit, span in spans.items() if _SHORTEST_SWEEP_S <= span <= _LONGEST_SWEEP_S]
    return min(fitting, key=lambda unit: abs(np.log(spans[unit] / _SWEEP_S)), default=None)


def _reference_by_size(spread: ValueSpread, unit: str) -> str:
    largest_s = max(abs(spread.first), abs(spread.last)) / UNITS_PER_SECOND[unit]
    return "relative" if largest_s <= CLOCK_LIMIT_S else "absolute"


def infer_point_time(
    field: str,
    values: NDArray[np.generic],
    stamp: float | None,
    unit: TimeUnit = "auto",
    reference: TimeReference = "auto",
    period_s: float | None = None,
) -> PointTimeModel | None:
    """Infer unit and reference of a time field from the raw values (N,) of one scan with a stamp in seconds.

    Values that read the same as the stamp in some unit are absolute in that unit. Otherwise the unit is the one in
    which they span a sweep (about `period_s`, where known), and they are relative if none exceeds a second, else
    readings of a clock of their own. A stamp within two seconds of zero cannot tell the two apart: infer from a later
    scan. A given unit or reference is not questioned.

    Returns:
        None when the values are no per-point time: `reference` is "none", all values are equal, too coarse (an epoch
        in float32), or span a sweep in no unit; the last two are logged as a warning.
    """
    if reference == "none":
        return None
    spread = value_spread(np.asarray(values))
    if spread is None:
        return None
    if spread.resolution > _COARSEST_OF_SWEEP * spread.span:
        logger.warning("time field %r is too coarse (steps of %g): ignored", field, spread.resolution)
        return None
    units = tuple(UNITS_PER_SECOND) if unit == "auto" else (unit,)
    if reference != "relative" and (by_clock := _unit_by_clock(spread, stamp, units)) is not None:
        return PointTimeModel(field, by_clock, "absolute")
    by_span = _unit_by_span(spread, units, period_s) if unit == "auto" else unit
    if by_span is None:
        logger.warning(
            "time field %r (%.9g to %.9g) spans a sweep in no unit: ignored; set time_unit if it is a time",
            field,
            spread.first,
            spread.last,
        )
        return None
    model = PointTimeModel(field, by_span, _reference_by_size(spread, by_span) if reference == "auto" else reference)
    if model.reference == "absolute" and stamp is not None and not model.shares_clock(np.asarray(values), stamp):
        logger.warning(
            "time field %r reads another clock than the scans' stamps: the earliest point of a scan gets its stamp",
            field,
        )
    return model
