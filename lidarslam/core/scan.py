"""One sweep of a LiDAR, the attributes of its points, and the protocol of a recording."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Annotated, Any, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from lidarslam.core.compiled import compiled
from lidarslam.core.geometry import FloatArray
from lidarslam.core.state import Shape
from lidarslam.core.trajectory import Trajectory

# No LiDAR reaches farther; points beyond are a driver's marker or a damaged file.
_MAX_RANGE_M = 10_000.0
# No LiDAR has more lasers; a number beyond is that of something else, or damaged.
_MOST_RINGS = 4096
# The fields of a scan with an entry for each point, other than the points.
_COLUMNS = ("time_offsets", "rings", "intensities", "colours")


@dataclass(frozen=True, eq=False)
class PointAttributes:
    """Attributes of N points; None where no point has one."""

    intensity: NDArray[np.float32] | None = None  # (N,) on the scale of the recording; NaN where there is none
    rgb: NDArray[np.uint8] | None = None  # (N, 3) red, green, blue; black where there is none
    ring: NDArray[np.int32] | None = None  # (N,) the laser; -1 where it is unknown
    time: NDArray[np.float64] | None = None  # (N,) seconds, on the clock of the scans' stamps

    def __post_init__(self) -> None:
        lengths = {name: len(values) for name, values in self.present()}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"attributes of the same points differ in length: {lengths}")
        if self.rgb is not None and (self.rgb.ndim != 2 or self.rgb.shape[1] != 3):
            raise ValueError(f"rgb must be (N, 3), got {self.rgb.shape}")

    def present(self) -> Iterator[tuple[str, NDArray[np.generic]]]:
        """Names and values of the known ones."""
        named = ((field.name, getattr(self, field.name)) for field in fields(self))
        return ((name, values) for name, values in named if values is not None)

    def only(self, names: Collection[str]) -> "PointAttributes":
        """Those with some names."""
        return PointAttributes(**{name: values for name, values in self.present() if name in names})  # type: ignore[arg-type]

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> "PointAttributes":
        """Those of some of the points, by a mask or by indices."""
        return PointAttributes(**{name: values[chosen] for name, values in self.present()})  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class Scan:
    """One sweep, in the LiDAR frame (x forward, z up)."""

    points: Annotated[FloatArray, Shape(None, 3)]  # (N, 3) float64, metres, finite, none at the origin
    stamp: float  # seconds; the instant the scan's pose belongs to
    # (N,) float64, seconds from the stamp at which each point was measured; None when unknown or when the points are
    # already motion compensated to the stamp
    time_offsets: Annotated[FloatArray, Shape(None)] | None = None
    # (N,) int32, the laser each point came from; None when unknown
    rings: Annotated[NDArray[np.int32], Shape(None)] | None = None
    dropped: int = 0  # number of points of the raw sweep that were left out as invalid
    # (N,) as recorded, on whatever scale; None when unknown
    intensities: Annotated[NDArray[np.float32], Shape(None)] | None = None
    colours: Annotated[NDArray[np.uint8], Shape(None, 3)] | None = None  # (N, 3) red, green, blue; None when unknown
    untimed: int = 0  # number of points whose missing time was interpolated between those of their neighbours

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise ValueError(f"Scan.points must be (N, 3), got {self.points.shape}")
        for name in _COLUMNS:
            values, expected = getattr(self, name), (len(self), 3) if name == "colours" else (len(self),)
            if values is not None and values.shape != expected:
                raise ValueError(f"Scan.{name} must be {expected}, got {values.shape}")
        if not np.isfinite(self.stamp):
            raise ValueError(f"Scan.stamp must be finite, got {self.stamp}")

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def middle_offset_s(self) -> float:
        """Seconds from the stamp to the middle of the sweep; 0 where points have no times."""
        if self.time_offsets is None or not len(self):
            return 0.0
        return float(0.5 * (self.time_offsets.min() + self.time_offsets.max()))

    def attributes(self, wanted: Collection[str]) -> PointAttributes:
        """The wanted attributes of the points, as far as there are any.

        Rings come with times, by which a map chooses among points; without offsets the time is the stamp.
        """
        offsets = np.zeros(len(self)) if self.time_offsets is None else self.time_offsets
        return PointAttributes(
            intensity=self.intensities if "intensity" in wanted else None,
            rgb=self.colours if "rgb" in wanted else None,
            ring=self.rings if "ring" in wanted else None,
            time=self.stamp + offsets if {"ring", "time"} & set(wanted) else None,
        )

    @classmethod
    def from_raw(
        cls,
        points: ArrayLike,
        stamp: float,
        time_offsets: ArrayLike | None = None,
        rings: ArrayLike | None = None,
        intensities: ArrayLike | None = None,
        colours: ArrayLike | None = None,
    ) -> Self:
        """Make a scan of a driver's raw points, leaving out invalid ones with their attributes.

        Organised clouds (..., 3) are flattened. Left out are points with a coordinate that is not finite, points at
        the origin (a driver's mark for "no return") and points beyond 10 km. A time that is not finite is
        interpolated between the nearest ones in the stored order; where that is more than half of the points, the
        times are useless and are left out. So are rings when one of them is no number of a laser.
        """
        with np.errstate(invalid="ignore"):  # damaged bytes may be any number
            raw = np.asarray(points, dtype=np.float64)
        if raw.size and raw.shape[-1] != 3:
            raise ValueError(f"points must be (..., 3), got {raw.shape}")
        xyz = raw.reshape(-1, 3)
        offsets = _column("time_offsets", time_offsets, len(xyz), np.float64)
        with np.errstate(over="ignore", invalid="ignore"):
            brightness = _column("intensities", intensities, len(xyz), np.float32)
        rgb = None if colours is None else _colours(colours, len(xyz))
        columns: list[Any] = [offsets, _column("rings", rings, len(xyz), None), brightness, rgb]
        xyz, valid = np.ascontiguousarray(xyz), np.empty(len(xyz), dtype=np.bool_)
        dropped = _find_valid(xyz, valid)
        untimed = 0
        if offsets is not None:
            timed = valid & np.isfinite(offsets)
            untimed = int(np.count_nonzero(valid) - np.count_nonzero(timed))
            if untimed > np.count_nonzero(timed):
                columns[0], untimed = None, 0
            elif untimed:
                columns[0] = _interpolated(offsets, timed, valid & ~timed)
        if dropped:
            kept = np.flatnonzero(valid)
            xyz = xyz.take(kept, axis=0)  # four times as fast as indexing with the mask
            columns = [None if values is None else values.take(kept, axis=0) for values in columns]
        offsets, lasers, brightness, rgb = columns
        # Invalid points may carry NaN for a ring, which no integer can hold: judge and cast the others.
        if lasers is not None and not ((lasers >= 0) & (lasers < _MOST_RINGS)).all():
            lasers = None
        lasers = None if lasers is None else lasers.astype(np.int32)
        return cls(xyz, float(stamp), offsets, lasers, dropped, brightness, rgb, untimed)

    def with_times_scaled(self, scale: float) -> "Scan":
        """The scan with the times of its points, from the stamp, multiplied by a factor."""
        if self.time_offsets is None or scale == 1.0:
            return self
        return replace(self, time_offsets=scale * self.time_offsets)

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> "Scan":
        """The scan with only the chosen points (a mask or indices), and their attributes."""
        chosen = np.flatnonzero(chosen) if chosen.dtype == np.bool_ else chosen
        columns = {name: getattr(self, name) for name in _COLUMNS}
        return Scan(
            self.points.take(chosen, axis=0),  # four times as fast as indexing
            self.stamp,
            dropped=self.dropped,
            untimed=self.untimed,
            **{name: None if values is None else values.take(chosen, axis=0) for name, values in columns.items()},
        )


def squared_ranges(points: FloatArray) -> FloatArray:
    """Squared distances (N,) of points (N, 3) from the origin."""
    squared = np.empty(len(points))
    _write_squared_ranges(np.ascontiguousarray(points), squared)
    return squared


def median_gap_m(points: FloatArray, samples: int) -> float | None:
    """Median distance of some of the points (N, 3) from their nearest neighbours; None of fewer than two points."""
    from scipy.spatial import cKDTree  # takes a while to load

    if len(points) < 2:
        return None
    some = points[:: max(1, len(points) // samples)]
    distances, _ = cKDTree(points, balanced_tree=False, compact_nodes=False).query(some, k=2)
    return float(np.median(np.asarray(distances)[:, 1]))


@compiled
def _write_squared_ranges(points: FloatArray, squared: FloatArray) -> None:
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        squared[n] = x * x + y * y + z * z


@compiled
def _find_valid(points: FloatArray, valid: NDArray[np.bool_]) -> int:
    """Write which points (N, 3) are valid: finite, not at the origin, within 10 km; return the number of others."""
    dropped = 0
    for n in range(len(points)):
        x, y, z = abs(points[n, 0]), abs(points[n, 1]), abs(points[n, 2])
        is_near = x < _MAX_RANGE_M and y < _MAX_RANGE_M and z < _MAX_RANGE_M  # not NaN
        valid[n] = is_near and x + y + z > 0.0
        dropped += not valid[n]
    return dropped


def _interpolated(offsets: FloatArray, timed: NDArray[np.bool_], untimed: NDArray[np.bool_]) -> FloatArray:
    """Times (N,) of which those that are missing lie between their neighbours in the stored order.

    Where these are more than half a sweep apart, as from one ring to the next, it is the middle of the sweep.
    """
    known, missing = np.flatnonzero(timed), np.flatnonzero(untimed)
    times = offsets[known]
    after = np.searchsorted(known, missing)
    earlier, later = times[np.maximum(after - 1, 0)], times[np.minimum(after, len(known) - 1)]
    first, last = times.min(), times.max()
    filled = offsets.copy()
    is_near = np.abs(later - earlier) <= 0.5 * (last - first)
    filled[missing] = np.where(is_near, np.interp(missing, known, times), 0.5 * (first + last))
    return filled


def _column(name: str, values: ArrayLike | None, count: int, dtype: DTypeLike | None) -> NDArray[Any] | None:
    """An attribute (N,) of N points; without a dtype, of whatever type it has."""
    if values is None:
        return None
    column = np.asarray(values, dtype=dtype).reshape(-1)
    if len(column) != count:
        raise ValueError(f"{name} has {len(column)} entries for {count} points")
    return column


def _colours(values: ArrayLike, count: int) -> NDArray[np.uint8]:
    colours = np.asarray(values, dtype=np.uint8)
    if colours.size != 3 * count or (colours.size and colours.shape[-1] != 3):
        raise ValueError(f"colours must be (..., 3) for {count} points, got {colours.shape}")
    return colours.reshape(-1, 3)


class ScanSequence(Protocol):
    """One recording: scans in the order of time, streamed, so that memory does not grow with its length."""

    @property
    def name(self) -> str:
        """A short name for tables and windows."""

    @property
    def ground_truth(self) -> Trajectory | None:
        """T_world_lidar at the truth's own stamps (the world is the truth's); None when the recording has none."""

    def __len__(self) -> int:
        """Number of scans of the recording."""

    def scans(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[Scan]:
        """The scans with the indices of `range(start, stop, step)`; the ones between are not decoded."""
