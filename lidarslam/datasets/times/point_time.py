"""Time of each point of a sweep: which field holds it, and its offsets from the scan's stamp."""

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.datasets.config import TimeReference, TimeUnit
from lidarslam.datasets.point_table import RawCloud

UNITS_PER_SECOND = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}
# Units of times that were divided or multiplied once too often; not among the settings.
MISTAKEN_UNITS_PER_SECOND = {"ks": 1e-3, "Ms": 1e-6, "ps": 10**12}

# A sweep and its stamp are closer than this; a time farther away is on another clock, or is no time at all.
CLOCK_LIMIT_S = 1.0
_MEDIAN_SAMPLE = 2048
logger = logging.getLogger(__name__)
# Number of clouds that are examined, and how many of them may lack usable times.
_CLOUDS_LOOKED_AT, _CLOUDS_WITHOUT_TIME = 30, 3
# Sweeps last 0.02 to 0.3 s. The limits leave room for partial ones and are less than one unit (1000) apart.
_SWEEP_S, _SHORTEST_SWEEP_S, _LONGEST_SWEEP_S = 0.1, 0.005, 1.0
# Seconds since 1970 read as nanoseconds are 1.7 s, which may be near the stamp; a sweep is then shorter than this.
_NO_SWEEP_S = 1e-6
# The same relative to the time between scans, where that is known and itself plausible.
_SHORTEST_OF_PERIOD, _LONGEST_OF_PERIOD = 0.05, 1.5
_PLAUSIBLE_PERIOD_S = (1e-3, 2.0)
# A span so near to the time between scans, in another unit than expected, determines the unit.
_WHOLE_SWEEP = (0.8, 1.1)
# Values from about zero to one are fractions of a sweep, where that is shorter than this.
_WHOLE = (-0.02, 1.1)
_LONGEST_FRACTION_S = 0.5
_IN_WORDS = {"ks": "1000 s", "Ms": "1,000,000 s"}
# Times coarser than this part of the sweep do not separate its points.
_COARSEST_OF_SWEEP = 0.1
# Instead of the extremes, so that a few stray values do not matter.
_QUANTILES = (0.005, 0.5, 0.995)
# No clock reads this, in any unit; the difference of two damaged values could overflow.
_NO_CLOCK = 1e100


@dataclass(frozen=True)
class PointTimeModel:
    """Conversion of a time field's raw values to seconds from the scan's stamp."""

    field: str  # name of the field
    unit: str  # "s", "ms", "us" or "ns"; of mistaken values "ks", "Ms" or "ps"
    reference: str  # "relative" (the values count from the stamp) or "absolute" (they read a clock)

    @property
    def units_per_second(self) -> float:
        """Number of units per second."""
        return UNITS_PER_SECOND.get(self.unit) or MISTAKEN_UNITS_PER_SECOND[self.unit]

    def offsets(self, values: NDArray[np.generic], stamp: float) -> FloatArray:
        """Seconds from the stamp, float64, of the shape of the values (N,).

        Exact to a nanosecond for integers, and to the resolution of the values for floats. Times more than a second
        from the stamp are of another clock: they are shifted so that the earliest point has offset zero. Single
        times more than a second from the median are NaN, as `Scan.from_raw` expects of points without a time.
        """
        middle = self._middle(values)
        if middle is None:
            return np.full(values.shape, np.nan)
        same_clock = self._is_near(middle, self._zero(stamp))
        zero = self._zero(stamp) if same_clock else middle
        offsets = self._seconds_since(zero, values)
        astray = ~(np.abs(offsets - float((middle - zero) / self.units_per_second)) <= CLOCK_LIMIT_S)
        if astray.any():
            offsets[astray] = np.nan
        return offsets if same_clock else offsets - np.nanmin(offsets)

    def shares_clock(self, values: NDArray[np.generic], stamp: float) -> bool:
        """Whether the times and the stamp are readings of one clock, so that `offsets` need not shift them."""
        middle = self._middle(values)
        return middle is None or self._is_near(middle, self._zero(stamp))

    def _zero(self, stamp: float) -> Fraction:
        return Fraction(stamp) * Fraction(self.units_per_second) if self.reference == "absolute" else Fraction(0)

    def _is_near(self, reading: Fraction, other: Fraction) -> bool:
        return abs(reading - other) <= CLOCK_LIMIT_S * self.units_per_second

    def _middle(self, values: NDArray[np.generic]) -> Fraction | None:
        """About the median, one of the values; from a sample, because every scan needs it."""
        sample = values[:: max(1, len(values) // _MEDIAN_SAMPLE)]
        sample = sample[np.isfinite(sample)]
        if self.reference == "absolute" and (set_times := sample[sample != 0]).size:
            sample = set_times  # a clock that reads zero is a missing return
        return Fraction(np.sort(sample)[len(sample) // 2].item()) if len(sample) else None

    def _seconds_since(self, zero: Fraction, values: NDArray[np.generic]) -> FloatArray:
        # Differences to the nearest reading are exact in the values' own type and unit, and so is the rest of that
        # reading; converted to seconds first, an epoch would have lost its nanoseconds.
        per_second = self.units_per_second
        if values.dtype.kind in "iu":
            nearest = round(zero)
            wrapped = np.array(nearest % 2**64, dtype=np.uint64)  # modulo 2^64 any integers may be subtracted
            difference = (values.astype(np.uint64) - wrapped).astype(np.int64)
            return np.asarray(difference / per_second + float((nearest - zero) / per_second))
        rounded = float(zero)
        with np.errstate(invalid="ignore", over="ignore"):  # damaged bytes may be any number
            seconds = (values.astype(np.float64) - rounded) / per_second
        return np.asarray(seconds + float((Fraction(rounded) - zero) / per_second))


class LearnedTime(NamedTuple):
    """The inferred meaning of a time field."""

    model: PointTimeModel | None = None  # None: it gives the points no times
    # A correction, or another clock; without a model, its fault, to be continued with a semicolon.
    warning: str | None = None


def learn_point_time(
    clouds: Iterable[tuple[RawCloud, float | None]],
    unit: TimeUnit = "auto",
    reference: TimeReference = "auto",
    period_s: float | None = None,
    defined_unit: TimeUnit | None = None,
) -> LearnedTime:
    """By the first cloud, with its scan's stamp if known, whose times are unambiguous, else by the last with any.

    Stamps close to zero are ambiguous: times from 0 to 0.1 s are then relative as well as absolute.
    """
    learned, failures = LearnedTime(), 0
    for cloud, stamp in islice(clouds, _CLOUDS_LOOKED_AT):
        values = None if cloud.times is None else cloud.times[cloud.returns]
        if values is not None and len(values) < 2:
            continue  # an empty scan shows nothing of the field
        found = LearnedTime()
        if cloud.time_field is not None and values is not None:
            found = infer_point_time(cloud.time_field, values, stamp, unit, reference, period_s, defined_unit)
        elif reference not in ("none", "azimuth"):
            found = LearnedTime(None, _unknown_field(cloud))
        learned = found if found.model is not None or learned == LearnedTime() else learned
        failures += found.model is None
        is_clear = stamp is None or abs(stamp) > 2 * CLOCK_LIMIT_S
        if (found.model is not None and is_clear) or failures == _CLOUDS_WITHOUT_TIME:
            break
    model = learned.model
    known = "none is known" if model is None else f"field {model.field!r} in {model.unit}, {model.reference}"
    logger.info("time of a point: %s", known)
    return learned


def _unknown_field(cloud: RawCloud) -> str | None:
    for field in cloud.fields:
        if "time" in (name := field.name).lower():
            return f"The points have no time field of a known name; if {name!r} is one, --set reader.time_field={name}"
    return None


def infer_point_time(
    field: str,
    values: NDArray[np.generic],
    stamp: float | None,
    unit: TimeUnit = "auto",
    reference: TimeReference = "auto",
    period_s: float | None = None,
    defined_unit: TimeUnit | None = None,
) -> LearnedTime:
    """Infer unit and reference of a time field from the raw values (N,) of one scan with a stamp in seconds.

    Values that read the same as the stamp in some unit are absolute in that unit. Otherwise the unit is the one in
    which they span a sweep (about `period_s`, where known), and they are relative if none exceeds a second, else
    readings of a clock of their own. Values that were divided or multiplied by a thousand once too often, so that
    they span the whole period (0.1 s where it is unknown) in another unit alone, are corrected with a warning. A given
    unit or reference is not questioned; `defined_unit`, by the definition of a message, gives way to such a correction.

    Returns:
        No model when the values are no per-point time: `reference` is "none" or "azimuth", all values are equal, too
        coarse (an epoch in float32), or span a sweep in no unit; but for the first, the warning says so. With a model,
        the warning says how it corrects the values, or that they read another clock than the stamp.
    """
    if reference in ("none", "azimuth") or not len(values):
        return LearnedTime()
    spread, sweep_s = value_spread(values), period_s if period_s is not None and _is_plausible(period_s) else _SWEEP_S
    fault = _fault(values, spread, sweep_s, unit)
    if spread is None or fault is not None:
        return LearnedTime(None, f"The time field {field!r} {fault}")
    given = defined_unit if unit == "auto" else unit
    units = tuple(UNITS_PER_SECOND) if given is None else (given,)
    by_clock = None if reference == "relative" else _unit_by_clock(spread, stamp, units)
    found = by_clock or given or _unit_by_span(spread, period_s)
    mistaken = _unit_by_whole_sweep(spread, found, sweep_s) if unit == "auto" else None
    if mistaken is not None:
        return LearnedTime(
            PointTimeModel(field, mistaken, _reference(spread, mistaken, reference)),
            f"The time field {field!r} spans {spread.span:.3g}, a sweep of {sweep_s:.3g} s in units of"
            f" {_IN_WORDS.get(mistaken, mistaken)}{'' if found is None else f' instead of {found}'}, and is read so;"
            " --set reader.time_unit gives another.",
        )
    if found is None:
        span = f"({spread.first:.9g} to {spread.last:.9g})"
        return LearnedTime(None, f"The time field {field!r} {span} spans a sweep in no unit")
    model = PointTimeModel(field, found, "absolute" if by_clock else _reference(spread, found, reference))
    warning = None
    if model.reference == "absolute" and stamp is not None and not model.shares_clock(values, stamp):
        said = f"The time field {field!r} reads another clock than the scans' stamps"
        warning = f"{said}, so the earliest point of each scan gets its stamp."
    return LearnedTime(model, warning)


def _reference(spread: "ValueSpread", unit: str, reference: TimeReference) -> str:
    if reference != "auto":
        return reference
    largest_s = max(abs(spread.first), abs(spread.last)) / PointTimeModel("", unit, "").units_per_second
    return "relative" if largest_s <= CLOCK_LIMIT_S else "absolute"


class ValueSpread(NamedTuple):
    """The values of one scan, in their own unit."""

    # first, middle, last: near the smallest, the median and near the largest, a few stray values left out
    first: float
    middle: float
    last: float
    span: float  # last minus first, without the rounding of large values
    resolution: float  # the step between neighbouring values at this size


def value_spread(values: NDArray[np.generic]) -> ValueSpread | None:
    """The spread of integer or float values (N,) that may be times; None when all, or all but a few, are equal."""
    whole = values.dtype.kind in "iu"
    with np.errstate(invalid="ignore"):  # damaged bytes may be a NaN of the signalling kind
        numbers = values.reshape(-1).astype(np.int64 if whole else np.float64)
    numbers = numbers[np.abs(numbers) < _NO_CLOCK]  # nor NaN
    set_times = numbers[numbers != 0]
    # Among clock readings a zero is a missing return; among relative times it is a time.
    if len(set_times) and np.abs(set_times).min() > 10 * float(np.ptp(set_times)):
        numbers = set_times
    if len(numbers) < 2:
        return None
    base = numbers.min()
    first, middle, last = np.quantile((numbers - base).astype(np.float64), _QUANTILES)
    if last <= first:
        return None
    resolution = 1.0 if whole else float(np.spacing(values.dtype.type(np.abs(numbers).max())))
    return ValueSpread(float(base + first), float(base + middle), float(base + last), float(last - first), resolution)


def _fault(values: NDArray[np.generic], spread: ValueSpread | None, sweep_s: float, unit: TimeUnit) -> str | None:
    """Why values (N,) are no times, the end of a sentence; None where they may be."""
    if spread is None:
        known = values[np.isfinite(values)]
        return f"holds one value alone ({float(np.median(known)):.9g})" if len(known) else "holds no number"
    if spread.resolution > _COARSEST_OF_SWEEP * spread.span:
        return f"is too coarse, with steps of {spread.resolution:g}"
    is_whole = _WHOLE[0] <= spread.first and spread.last <= _WHOLE[1] and spread.span >= _WHOLE_SWEEP[0]
    if is_whole and values.dtype.kind == "f" and unit == "auto" and sweep_s < _LONGEST_FRACTION_S:
        setting = f"reader.time_unit=s --set reader.time_reference=relative --set reader.time_scale={sweep_s:.3g}"
        return f"has fractions of a sweep, from 0 to 1; --set {setting} takes them"
    return None


def _is_plausible(period_s: float) -> bool:
    return _PLAUSIBLE_PERIOD_S[0] <= period_s <= _PLAUSIBLE_PERIOD_S[1]


def _unit_by_clock(spread: ValueSpread, stamp: float | None, units: Sequence[str]) -> str | None:
    if stamp is None or abs(stamp) <= 2 * CLOCK_LIMIT_S:  # ambiguous: relative times read about the same
        return None
    for unit in units:
        per_second = UNITS_PER_SECOND[unit]
        reads_the_same = abs(spread.middle / per_second - stamp) <= CLOCK_LIMIT_S
        if reads_the_same and _NO_SWEEP_S < spread.span / per_second <= _LONGEST_SWEEP_S:
            return unit
    return None


def _unit_by_span(spread: ValueSpread, period_s: float | None) -> str | None:
    spans = {unit: spread.span / per_second for unit, per_second in UNITS_PER_SECOND.items()}
    if period_s is not None and _is_plausible(period_s):
        for unit, span in spans.items():
            if _SHORTEST_OF_PERIOD * period_s <= span <= _LONGEST_OF_PERIOD * period_s:
                return unit
    fitting = [unit for unit, span in spans.items() if _SHORTEST_SWEEP_S <= span <= _LONGEST_SWEEP_S]
    return min(fitting, key=lambda unit: abs(np.log(spans[unit] / _SWEEP_S)), default=None)


def _unit_by_whole_sweep(spread: ValueSpread, expected: str | None, sweep_s: float) -> str | None:
    """The unit in which the values span a whole sweep, where they span no part of it in the expected one."""
    parts = {
        unit: spread.span / per_second / sweep_s
        for unit, per_second in (UNITS_PER_SECOND | MISTAKEN_UNITS_PER_SECOND).items()
    }
    if expected is not None and _SHORTEST_OF_PERIOD <= parts[expected] <= _LONGEST_OF_PERIOD:
        return None
    return next((unit for unit, part in parts.items() if _WHOLE_SWEEP[0] <= part <= _WHOLE_SWEEP[1]), None)
