"""Time of each point of a sweep: which field holds it, and its offsets from the scan's stamp."""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray

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
# What times come in that were divided or multiplied once too often; not among the settings.
MISTAKEN_UNITS_PER_SECOND = {"ks": 1e-3, "Ms": 1e-6, "ps": 10**12}

# A sweep and its stamp are closer than this; a time farther away is on another clock, or is no time at all.
CLOCK_LIMIT_S = 1.0
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


def is_return(points: FloatArray) -> NDArray[np.bool_]:
    """Mask (N,) of the points (N, 3) that are returns of the laser; drivers leave any time in the others."""
    return np.asarray(np.isfinite(points).all(axis=1) & points.any(axis=1))


@dataclass(frozen=True)
class PointTimeModel:
    """Conversion of a time field's raw values to seconds from the scan's stamp."""

    field: str  # name of the field
    unit: str  # "s", "ms", "us" or "ns"; of mistaken values "ks", "Ms" or "ps"
    reference: str  # "relative" (the values count from the stamp) or "absolute" (they read a clock)

    @property
    def units_per_second(self) -> float:
        """How many units a second has."""
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
        """The field's reading at the stamp."""
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
