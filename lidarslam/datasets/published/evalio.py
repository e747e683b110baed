"""Data sets that evalio reads: their names and folders, and their scans, IMU, truth and calibration as a recording.

evalio decodes points one after another; the scans between the wanted ones are decoded too."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.files import reading
from lidarslam.core.geometry import FloatArray, inverse, orthonormalize
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.point_table import PointField
from lidarslam.datasets.published.catalogue import CATALOGUE
from lidarslam.datasets.published.stamped_files import increasing
from lidarslam.datasets.recording import Recording, StoredRecording
from lidarslam.datasets.times.point_time import PointTimeModel
from lidarslam.datasets.times.stamps import increasing_rows

PREFIX = "evalio:"
MISSING_EXTRA = "evalio is not installed, which this data set needs; pip install 'lidarslam[datasets]'"

# As evalio 0.6.1 has them.
DATA_SETS = tuple(one.name for one in CATALOGUE if one.reader == "evalio")
# Published where programs cannot download.
_BY_HAND = ("botanic_garden",)
_POINT = attrgetter("x", "y", "z", "intensity", "row")
_FIELDS = (*((name, "float64") for name in ("x", "y", "z", "intensity")), ("t", "ns"), ("row", "uint8"))
# Their true orientations are missing or made up.
_POSITIONS_ALONE = ("enwide", "fomo")
_UNREADABLE = "scans were left out: evalio could not read on"


def data_folder() -> Path:
    """Where evalio keeps its data: EVALIO_DATA, or evalio_data in the current folder."""
    return Path(os.environ.get("EVALIO_DATA", "evalio_data")).absolute()


def located(source: Path) -> Path:
    """The folder DATASET/SEQUENCE that a name stands for; other sources as they are."""
    name = str(source)
    return data_folder() / name.removeprefix(PREFIX) if name.startswith(PREFIX) else source


def is_of_evalio(source: Path) -> bool:
    """Whether a path reads DATASET/SEQUENCE as evalio lays out its data; data sets of others need EVALIO_CUSTOM."""
    data_set = source.absolute().parent.name
    return data_set in DATA_SETS or (bool(os.environ.get("EVALIO_CUSTOM")) and data_set in sequences())


def resolved(source: Path) -> Path:
    """The absolute path; links are resolved, but for one that would hide DATASET/SEQUENCE."""
    path = source.resolve()
    return source.absolute() if is_of_evalio(source) and not is_of_evalio(path) else path


def full_name(source: Path) -> str:
    """DATASET/SEQUENCE of a folder."""
    return f"{source.absolute().parent.name}/{source.name}"


def sequences() -> dict[str, tuple[str, ...]]:
    """The sequences of each data set that evalio knows, those of EVALIO_CUSTOM too; none where it is not installed."""
    try:
        from evalio import datasets
    except ImportError:
        return {}
    known = datasets.all_datasets()
    return {name: tuple(one.seq_name for one in known[name].sequences()) for name in sorted(known)}


def how_to_get(source: Path) -> str:
    """The command that downloads a sequence to where it is looked for."""
    if source.absolute().parent.name in _BY_HAND:
        return f"its page has the files, for {source.absolute()}"
    root = source.absolute().parent.parent
    place = "" if os.environ.get("EVALIO_DATA") and root == data_folder() else f"-D {root} "
    return f"evalio {place}dl {full_name(source)}"


def absent(source: Path) -> str | None:
    """Why a folder of evalio's is not there and how to get it; None of any other path."""
    folder = source.absolute()
    if not (folder.is_relative_to(data_folder()) or is_of_evalio(folder) or folder.name in DATA_SETS):
        return None
    known = sequences()
    if known and source.name not in known.get(folder.parent.name, ()):
        return _unknown(source)
    install = "" if known else "; evalio comes with pip install 'lidarslam[datasets]'"
    return f"{source}: is not downloaded: {how_to_get(source)}{install}"


def _unknown(source: Path) -> str:
    data_set = next((name for name in (source.name, source.absolute().parent.name) if name in DATA_SETS), "")
    return f"{source}: is no sequence of evalio; there are those of `{f'lidarslam datasets {data_set}'.strip()}`"


def open_recording(source: Path, config: ReaderConfig) -> Recording:
    """Open a sequence in the folder DATASET/SEQUENCE that evalio downloads it to."""
    known = sequences()
    if not known:
        raise InputError(f"{source}: {MISSING_EXTRA}")
    if source.name not in known.get(source.absolute().parent.name, ()):
        raise InputError(f"{_unknown(source)}; a folder of another data set is read with --reader")
    from evalio import datasets

    return EvalioRecording(source.absolute(), config, datasets.get_sequence(full_name(source)))


class EvalioRecording(StoredRecording):
    """One sequence."""

    reader = "evalio"
    _point_time = PointTimeModel("t", "ns", "relative")
    _stored = tuple(PointField(name, kind) for name, kind in _FIELDS)

    def __init__(self, folder: Path, config: ReaderConfig, sequence: Any) -> None:
        super().__init__(folder, config)
        self._sequence = sequence  # evalio.datasets.Dataset
        if folder.parent.name in _POSITIONS_ALONE:
            self.warnings = ("The truth has positions alone; errors of rotation against it say nothing.",)
        lidar, imu = sequence.lidar_params(), sequence.imu_params()
        self.imu_name = f"{imu.brand} {imu.model}"
        self._notes = (
            f"{sequence.full_name} by evalio, {lidar.brand} {lidar.model}; stamps at the start of a sweep.",
            f"The duration is that of the scans at {lidar.rate:g} Hz, the sensor's rate.",
        )
        with self._reading("its list of files"):
            missing = [file for file in sequence.files() if not (folder / file).exists()]
        if missing:
            raise InputError(f"{folder}: {missing[0]} is missing, the download is not complete; {how_to_get(folder)}")

    @contextmanager
    def _reading(self, what: str) -> Iterator[None]:
        """evalio's data folder as that of this recording, and any error of evalio as one of the input."""
        from evalio.datasets import set_data_dir

        set_data_dir(self._source.parent.parent)
        with reading(self._source, f"evalio cannot read {what}", "download it again"):
            yield

    @property
    def name(self) -> str:
        """Such as hilti_2022_basement_2."""
        return str(self._sequence.full_name).replace("/", "_")

    def __len__(self) -> int:
        return self._length

    @cached_property
    def _length(self) -> int:
        with self._reading("the scans"):
            return len(self._sequence.data_iter())  # that of the sequence itself may be a number in its source

    @cached_property
    def _T_imu_lidar(self) -> FloatArray:
        return orthonormalize(np.asarray(self._sequence.imu_T_lidar().to_mat(), dtype=np.float64))

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """T_world_lidar: evalio's poses of the IMU with the extrinsic calibration."""
        with self._reading("the true poses"):
            truth = self._sequence.ground_truth()
            if truth is None or not len(truth):
                return None
            stamps = np.array([stamp.to_nsec() for stamp in truth.stamps]) * 1e-9
            T_world_imu = orthonormalize(np.stack([pose.to_mat() for pose in truth.poses]))
        return increasing(stamps, T_world_imu @ self._T_imu_lidar)

    @cached_property
    def imu(self) -> ImuSamples | None:
        """All samples; None where gravity was taken off the accelerations."""
        if not np.any(self._sequence.imu_params().gravity):
            return None
        with self._reading("the IMU"):
            samples = [(one.stamp.to_nsec(), *one.gyro, *one.accel) for one in self._sequence.data_iter().imu_iter()]
        table = np.array(samples, dtype=np.float64).reshape(-1, 7)
        table[:, 0] *= 1e-9
        table = table[increasing_rows(table[:, 0])]  # its units are known
        return ImuSamples(table[:, 0], table[:, 1:4], table[:, 4:], inverse(self._T_imu_lidar)) if len(table) else None

    def _items(self, wanted: range, faults: Faults) -> Iterator[Scan]:
        given = 0
        with self._reading("the scans"):
            measurements = self._sequence.data_iter().lidar_iter()
        for index in range(wanted.stop):
            try:
                with self._reading(f"scan {index}"):
                    measurement = next(measurements)
                    scan = _scan(measurement) if index in wanted else None
            except InputError as error:
                if faults.strict or not given:
                    raise
                faults.leave_out(_UNREADABLE, str(error), len(wanted) - given, is_readable=False)
                return
            if scan is not None:
                given += 1
                yield scan

    def _read(self, item: Scan, faults: Faults) -> Scan:  # noqa: ARG002
        return item

    def _last_stamp(self, first: Scan) -> float:
        return float(first.stamp + (len(self) - 1) / self._sequence.lidar_params().rate)

    @cached_property
    def _truth_path(self) -> Path | None:
        return None if self.ground_truth is None else self._source


def _scan(measurement: Any) -> Scan:
    """The scan of a LidarMeasurement, whose stamp is the start of the sweep."""
    table = np.array(list(map(_POINT, measurement.points)), dtype=np.float64).reshape(-1, 5)
    measured = table[:, :3].any(axis=1)  # evalio fills up its grid of rows and columns with zeros
    table, offsets = table[measured], np.array(measurement.to_vec_stamps(), dtype=np.float64)[measured]
    known = len(offsets) and np.ptp(offsets) > 0.0
    return Scan.from_raw(
        table[:, :3], measurement.stamp.to_nsec() * 1e-9, offsets if known else None, table[:, 4], table[:, 3]
    )
