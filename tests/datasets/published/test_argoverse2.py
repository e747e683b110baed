"""The Argoverse 2 reader on a log written with pyarrow in the published columns and types."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import exp, inverse, transform_points
from lidarslam.datasets.registry import choose_reader, open_recording

pyarrow = pytest.importorskip("pyarrow")

START_NS = 315_966_070_559_696_000
PERIOD_NS = 100_000_000
T_EGO_LIDAR = exp([0.0, 0.0, 0.1, 1.35, 0.0, 1.64])


def _T_city_ego(index: ArrayLike) -> np.ndarray:
    return exp([0.0, 0.0, 1.1, 1500.0, 900.0, 12.0]) @ exp(np.multiply.outer(index, [0.0, 0.0, 0.02, 0.9, 0.0, 0.0]))


def _pose_columns(T: np.ndarray) -> dict[str, list[float]]:
    quaternions = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    columns = dict(zip(("qx", "qy", "qz", "qw"), quaternions.T.tolist(), strict=True))
    return {**columns, **dict(zip(("tx_m", "ty_m", "tz_m"), T[:, :3, 3].T.tolist(), strict=True))}


def _write(path: Path, columns: dict[str, object]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pyarrow.feather.write_feather(pyarrow.table(columns), path)


@pytest.fixture
def log(tmp_path: Path, rng: np.random.Generator) -> SimpleNamespace:
    """Four sweeps, and poses ten times as often."""
    from pyarrow import feather  # noqa: F401  # makes pyarrow.feather

    folder = tmp_path / "02678d04-cc9f-3148-9f95-1ba66347dff9"
    clouds = []
    for index in range(4):
        points = rng.uniform(-60.0, 60.0, (50, 3)).astype(np.float16)
        clouds.append(points)
        columns = {
            **{axis: points[:, column] for column, axis in enumerate("xyz")},
            "intensity": np.arange(50, dtype=np.uint8),
            "laser_number": (np.arange(50) % 64).astype(np.uint8),
            "offset_ns": np.linspace(0, PERIOD_NS, 50).astype(np.int32),
        }
        _write(folder / "sensors" / "lidar" / f"{START_NS + index * PERIOD_NS}.feather", columns)
    times = np.arange(-5, 40)
    stamps = START_NS + times * (PERIOD_NS // 10)
    _write(folder / "city_SE3_egovehicle.feather", {"timestamp_ns": stamps, **_pose_columns(_T_city_ego(times / 10))})
    sensors = {"sensor_name": ["ring_front_center", "up_lidar", "down_lidar"]}
    mounted = _pose_columns(np.stack([np.eye(4), T_EGO_LIDAR, exp([3.1, 0.0, 0.0, 1.35, 0.0, 1.5])]))
    _write(folder / "calibration" / "egovehicle_SE3_sensor.feather", {**sensors, **mounted})
    return SimpleNamespace(folder=folder, clouds=clouds)


def test_sweeps_and_truth_are_in_the_frame_of_the_upper_lidar(log: SimpleNamespace) -> None:
    assert choose_reader(log.folder) == "argoverse-2"
    recording = open_recording(log.folder)
    assert (recording.name, len(recording)) == ("argoverse2_02678d04", 4)
    stamps = (START_NS + np.arange(4) * PERIOD_NS) * 1e-9
    for scan, stamp, cloud in zip(recording.scans(), stamps, log.clouds, strict=True):
        assert scan.stamp == pytest.approx(stamp)
        expected = transform_points(inverse(T_EGO_LIDAR), cloud.astype(np.float64))
        np.testing.assert_allclose(scan.points, expected, atol=1e-9)
        np.testing.assert_array_equal(scan.rings, np.arange(50) % 64)
        np.testing.assert_array_equal(scan.intensities, np.arange(50))
        assert scan.time_offsets is None
    truth = recording.ground_truth
    assert len(truth) == 45
    np.testing.assert_allclose(truth.at(stamps), _T_city_ego(np.arange(4)) @ T_EGO_LIDAR, atol=1e-6)


def test_without_calibration_both_stay_in_the_vehicles_frame(log: SimpleNamespace) -> None:
    (log.folder / "calibration" / "egovehicle_SE3_sensor.feather").unlink()
    recording = open_recording(log.folder)
    np.testing.assert_array_equal(next(recording.scans()).points, log.clouds[0])
    np.testing.assert_allclose(recording.ground_truth.at(np.array([START_NS * 1e-9]))[0], _T_city_ego(0), atol=1e-6)
    assert "are in the vehicle's frame" in recording.warnings[0]


def test_damaged_files_are_named(log: SimpleNamespace) -> None:
    sweep = next((log.folder / "sensors" / "lidar").iterdir())
    sweep.write_bytes(sweep.read_bytes()[:100])
    with pytest.raises(InputError, match=rf"{sweep.name}: cannot be read"):
        list(open_recording(log.folder).scans())
    _write(log.folder / "city_SE3_egovehicle.feather", {"timestamp_ns": [1, 2]})
    with pytest.raises(InputError, match=r"city_SE3_egovehicle.feather: cannot be read"):
        _ = open_recording(log.folder).ground_truth
    (log.folder / "sensors" / "lidar" / "map.feather").touch()
    with pytest.raises(InputError, match=r"map.feather: expected a name that is the sweep's stamp"):
        open_recording(log.folder)
