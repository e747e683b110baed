"""Recordings whose points may have times, of which field, unit and clock are inferred from the first scans."""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import cached_property
from typing import Any

from lidarslam.core.errors import InputError
from lidarslam.core.scan import Scan
from lidarslam.datasets.config import TimeReference, TimeUnit
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.point_table import PointField, RawCloud
from lidarslam.datasets.stored_recording import StoredRecording
from lidarslam.datasets.times.azimuth import PointTiming, point_timing
from lidarslam.datasets.times.point_time import LearnedTime, PointTimeModel, learn_point_time


class CloudRecording(StoredRecording):
    """A reader adds `__len__`, `_items`, `_last_stamp`, and the methods below that raise an error."""

    _has_stamps: bool = True  # whether stamps are readings of a clock, rather than made from the rate

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

    @property
    def _period_s(self) -> float | None:
        """Seconds between scans; None for a single one."""
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
        period_s = self._period_s if self._has_stamps else None
        return learn_point_time(self._stamped_clouds(), unit, reference, period_s, defined_unit)

    def _stamped_clouds(self) -> Iterator[tuple[RawCloud, float | None]]:
        for item in self._sound_items():
            with suppress(InputError):
                yield self._decode(item), self._stamp(item) if self._has_stamps else None

    def _readable(self, items: Iterable[Any]) -> Iterator[RawCloud]:
        for item in items:
            with suppress(InputError):
                yield self._decode(item)

    @cached_property
    def _timing(self) -> PointTiming:
        runs = (self._readable(run) for run in self._runs())
        return point_timing(self._learned, runs, self._period_s, self._config.time_reference)

    @cached_property
    def _point_time(self) -> PointTimeModel | None:
        return self._timing.model

    def _read(self, item: Any, faults: Faults) -> Scan:
        stamp = self._stamp(item)
        return self._timing.scan(self._decode(item), stamp, faults, f"{stamp:.9f}")

    def _fields(self, item: Any) -> tuple[PointField, ...]:
        return self._decode(item).fields
