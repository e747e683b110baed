"""Recordings of clouds: the times of their points are inferred, and parts of a sweep are joined."""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from itertools import islice
from typing import Any

from lidarslam.core.errors import InputError
from lidarslam.core.scan import Scan
from lidarslam.datasets.config import TimeReference, TimeUnit
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.point_table import PointField, RawCloud
from lidarslam.datasets.recording import RecordingInfo, StoredRecording, scan_indices
from lidarslam.datasets.sweeps import LOOKED_AT_S, SweepJoiner, directions_of, scans_of_a_sweep
from lidarslam.datasets.times.azimuth import PointTiming, point_timing
from lidarslam.datasets.times.point_time import LearnedTime, PointTimeModel, learn_point_time

# No LiDAR publishes faster: the unit of the stamps is wrong.
_LEAST_PERIOD_S = 1e-3


class CloudRecording(StoredRecording):
    """Scans whose points may have times, of which field, unit and clock are inferred from the first of them.

    Scans at 15 Hz and more are joined to sweeps, as far as consecutive ones see other directions; others where a
    duration of the sweeps is set. A reader adds `_stored_scans`, `_items`, `_last_stamp`, and the methods below that
    raise an error.
    """

    _has_stamps: bool = True  # whether stamps are readings of a clock, rather than made from the rate
    _facts_of_source: tuple[str, ...] = ()

    def _decode(self, item: Any) -> RawCloud:
        raise NotImplementedError

    def _stamp(self, item: Any) -> float:
        raise NotImplementedError

    def _sound_items(self) -> Iterable[Any]:
        """All items in their order, to infer from; those that cannot be decoded are counted when it is their turn."""
        raise NotImplementedError

    def _runs(self) -> Iterable[Iterable[Any]]:
        """Pairs of the items of consecutive scans, spread over the recording."""
        raise NotImplementedError

    @cached_property
    def period_s(self) -> float | None:
        """Seconds between scans; None for a single one."""
        raise NotImplementedError

    @cached_property
    def _faults_of_source(self) -> tuple[str, ...]:
        raise NotImplementedError

    @property
    def _defined_time(self) -> tuple[TimeUnit, TimeReference, TimeUnit | None]:
        """Unit and reference of the time field, and the unit by the definition of a message."""
        return self._config.time_unit, self._config.time_reference, None

    @cached_property
    def _learned(self) -> LearnedTime:
        if self._config.time_reference == "none":
            return LearnedTime()
        unit, reference, defined_unit = self._defined_time
        period_s = self.period_s if self._has_stamps else None
        return learn_point_time(self._readable(self._sound_items()), unit, reference, period_s, defined_unit)

    def _readable(self, items: Iterable[Any]) -> Iterator[tuple[RawCloud, float | None]]:
        """The clouds that can be decoded, with their stamps where these read a clock."""
        for item in items:
            with suppress(InputError):
                yield self._decode(item), self._stamp(item) if self._has_stamps else None

    @cached_property
    def _timing(self) -> PointTiming:
        runs = ((cloud for cloud, _ in self._readable(run)) for run in self._runs())
        return point_timing(self._learned, runs, self.period_s, self._config.time_reference)

    @cached_property
    def _point_time(self) -> PointTimeModel | None:
        return self._timing.model

    def _read(self, item: Any, faults: Faults) -> Scan:
        stamp = self._stamp(item)
        return self._timing.scan(self._decode(item), stamp, faults, f"{stamp:.9f}")

    def _fields(self, item: Any) -> tuple[PointField, ...]:
        return self._decode(item).fields

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """Faults of the source and of the points' times, and that scans are joined."""
        joined = (
            f"every {self._parts} scans are joined to one sweep of {self._sweep_s:.2g} s, as consecutive ones see"
            " different directions (--set reader.sweep_s=0 joins none)"
        )
        is_told = self._parts > 1 and self._config.sweep_s == "auto"
        return (*self._faults_of_source, *self._timing.warnings, *((joined,) if is_told else ()))

    @cached_property
    def _notes(self) -> tuple[str, ...]:
        return (*self._facts_of_source, *self._timing.notes)

    @cached_property
    def _parts(self) -> int:
        """Stored scans of a sweep."""
        if self.period_s is None or self.period_s < _LEAST_PERIOD_S:
            return 1
        if self._config.sweep_s != "auto":
            return max(1, round(self._config.sweep_s / self.period_s))
        with suppress(InputError):  # raised again when the scans are read
            stored = self._scans(range(self._stored_scans), Faults())
            first = islice(stored, round(LOOKED_AT_S / self.period_s))
            return scans_of_a_sweep(map(directions_of, first), self.period_s)
        return 1

    @property
    def _sweep_s(self) -> float:
        return self._parts * (self.period_s or 0.0)

    @cached_property
    def _first_stored(self) -> Scan:
        return self._first(Faults())[1]

    def _joiner(self) -> SweepJoiner:
        return SweepJoiner(self._sweep_s, self._sweep_s / self._parts, self._first_stored.stamp)

    def __len__(self) -> int:
        if self._parts == 1:
            return self._stored_scans
        return min(self._joiner().number_at(self._last_stamp(self._first_stored)) + 1, self._stored_scans)

    def scans(
        self, start: int = 0, stop: int | None = None, step: int = 1, faults: Faults | None = None
    ) -> Iterator[Scan]:
        """The sweeps with the indices of `range(start, stop, step)`; where they are joined, earlier ones are read."""
        wanted, scale = scan_indices(len(self), start, stop, step), self._config.time_scale
        read = wanted if self._parts == 1 else range(self._stored_scans)
        scans = (scan.with_times_scaled(scale) for scan in self._scans(read, faults))
        return scans if self._parts == 1 else self._sweeps(scans, wanted)

    def _sweeps(self, scans: Iterator[Scan], wanted: range) -> Iterator[Scan]:
        joiner = self._joiner()
        for scan in scans:
            number = joiner.number
            sweep = joiner.add(scan)
            if sweep is not None and number in wanted:
                yield sweep
            if joiner.number >= wanted.stop:
                return
        sweep = joiner.rest()
        if sweep is not None and joiner.number in wanted:
            yield sweep

    def describe(self) -> RecordingInfo:
        """The contents of the recording, its scans being the sweeps."""
        info = super().describe()
        if self._parts == 1:
            return replace(info, first=info.first.with_times_scaled(self._config.time_scale))
        first = next(self.scans(faults=Faults()))
        return replace(info, first=first, last_stamp=first.stamp + (len(self) - 1) * self._sweep_s)
