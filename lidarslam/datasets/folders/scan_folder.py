"""A folder of scan files: `.bin`, `.pcd`, `.ply` or `.npy`, one sweep each."""

from collections.abc import Iterator
from contextlib import suppress
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory, read_tum
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import NO_POINT_TIME, Faults
from lidarslam.datasets.folders.file_recording import FileRecording
from lidarslam.datasets.folders.formats import table_reader
from lidarslam.datasets.folders.layout import find_layout
from lidarslam.datasets.folders.point_table import coordinates, read_colours, read_intensities, scalar_fields
from lidarslam.datasets.imu_samples import IMU_FILE, read_imu_csv
from lidarslam.datasets.recording import PointField, Recording
from lidarslam.datasets.times.azimuth import (
    AZIMUTH_TIME,
    AzimuthTiming,
    Sweep,
    infer_azimuth_timing,
    pair_starts,
    time_warnings,
)
from lidarslam.datasets.times.point_time import (
    CLOCK_LIMIT_S,
    LearnedTime,
    PointTimeModel,
    TimedCloud,
    find_ring_field,
    find_time_field,
    is_return,
    learn_point_time,
)
from lidarslam.datasets.times.stamps import assumed_rate, scan_rate


def open_recording(source: Path, config: ReaderConfig) -> Recording:
    """Open a folder of scans.

    Raises:
        InputError: it holds no scans, or its stamp file does not go with them.
    """
    if not source.is_dir():
        raise InputError(f"{source}: expected a folder of scans, got a file; give the folder it lies in")
    return ScanFolderRecording(source, config)


class ScanFolderRecording(FileRecording):
    """The scans of one folder."""

    reader = "scan-folder"
    imu_name = IMU_FILE

    def __init__(self, folder: Path, config: ReaderConfig) -> None:
        self._layout = find_layout(folder, config.rate_hz)
        super().__init__(folder, config, self._layout.files)
        self.stamps = self._layout.stamps
        self._read_table = table_reader(self._layout.files)

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """The TUM file ground_truth.tum, groundtruth.tum or the like, in the folder or the one above."""
        return None if self._layout.truth is None else read_tum(self._layout.truth)

    @cached_property
    def imu(self) -> ImuSamples | None:
        """The table imu.csv in the folder or the one above."""
        return None if self._layout.imu is None else read_imu_csv(self._layout.imu)

    @property
    def warnings(self) -> tuple[str, ...]:
        """An assumed rate, how the stamps were mended, and what is wrong with the times of the points."""
        assumed = assumed_rate("The scans have no stamps", self._config) if self._rate_is_assumed else None
        assumed_warnings = () if assumed is None else (assumed,)
        return (*self._layout.warnings, *assumed_warnings, *time_warnings(self._learned, self._azimuth))

    def _table(self, index: int) -> tuple[NDArray[np.void], FloatArray]:
        path = self._files[index]
        table = self._read_table(path)
        try:
            return table, coordinates(table)
        except ValueError as error:
            raise InputError(f"{path}: {error}") from None

    def _read(self, index: int, faults: Faults) -> Scan:
        table, points = self._table(index)
        stamp, offsets = self._stamp_and_offsets(index, table, points)
        names = scalar_fields(table)
        rings = _rings(table)
        if offsets is None:
            offsets = self._azimuth.offsets(Sweep(points, rings))
        scan = Scan.from_raw(points, stamp, offsets, rings, read_intensities(table, names), read_colours(table, names))
        if self._point_time_model() is not None and scan.time_offsets is None and len(scan):
            faults.note(NO_POINT_TIME, str(self._files[index]))
        return scan

    def _stamp_and_offsets(
        self, index: int, table: NDArray[np.void], points: FloatArray
    ) -> tuple[float, FloatArray | None]:
        stamp, model = float(self.stamps[index]), self._point_time
        if model is None or not len(table) or model.field not in scalar_fields(table):
            return stamp, None
        values = table[model.field]
        if model.reference == "absolute" and not self._layout.from_clock:
            # The points' clock is better than an assumed rate: the sweep's first point gives the stamp.
            seconds = values[is_return(points)].astype(np.float64) / model.units_per_second
            seconds = seconds[np.isfinite(seconds)]
            if not len(seconds):
                return stamp, None
            stamp = float(seconds[np.abs(seconds - np.median(seconds)) <= CLOCK_LIMIT_S].min())
        return stamp, model.offsets(values, stamp)

    @property
    def _point_time(self) -> PointTimeModel | None:
        return self._learned.model

    @cached_property
    def _learned(self) -> LearnedTime:
        """Inferred once, so that all scans are read alike."""
        config = self._config
        if config.time_reference == "none":
            return LearnedTime()
        rate = scan_rate(self.stamps) if self._layout.from_clock else None
        period_s = None if rate is None else 1.0 / rate
        return learn_point_time(self._timed_clouds(), config.time_unit, config.time_reference, period_s)

    @property
    def _rate_is_assumed(self) -> bool:
        model = self._point_time
        return not (self._layout.from_clock or (model is not None and model.reference == "absolute"))

    @cached_property
    def _azimuth(self) -> AzimuthTiming:
        """Decided once, as well."""
        if self._point_time is not None:
            return AzimuthTiming()
        rate = scan_rate(self.stamps)
        runs = (self._sweeps(index) for index in pair_starts(len(self)))
        return infer_azimuth_timing(runs, None if rate is None else 1.0 / rate, self._config.time_reference)

    def _sweeps(self, first: int) -> Iterator[Sweep]:
        """Two consecutive scans, as far as they can be read."""
        for index in (first, first + 1):
            with suppress(InputError):  # counted when it is its turn
                table, points = self._table(index)
                yield Sweep(points, _rings(table))

    def _timed_clouds(self) -> Iterator[TimedCloud]:
        for index, stamp in enumerate(self.stamps):
            try:
                table, points = self._table(index)
            except InputError:
                continue  # counted when it is its turn
            field = find_time_field(scalar_fields(table), self._config.time_field)
            values = None if field is None else table[field][is_return(points)]
            yield TimedCloud(field, values, float(stamp) if self._layout.from_clock else None)

    def _last_stamp(self) -> float:
        """By its points' clock, which may be better than the rate."""
        try:
            return self._read(len(self) - 1, Faults()).stamp
        except InputError:
            return super()._last_stamp()

    def _truth_path(self) -> Path | None:
        return self._layout.truth

    def _point_time_model(self) -> PointTimeModel | None:
        return self._point_time if self._azimuth.period_s is None else AZIMUTH_TIME

    def _fields(self, index: int) -> tuple[PointField, ...]:
        table, _ = self._table(index)
        return tuple(PointField(name, str(table.dtype[name].base)) for name in table.dtype.names or ())

    def _notes(self) -> Iterator[str]:
        yield from self._layout.notes
        if self._azimuth.note is not None:
            yield self._azimuth.note


def _rings(table: NDArray[np.void]) -> NDArray[np.generic] | None:
    """The numbers (N,) of the points' lasers, as stored."""
    field = find_ring_field(scalar_fields(table))
    return None if field is None else table[field]
