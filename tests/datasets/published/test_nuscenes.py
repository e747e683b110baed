"""The nuScenes reader on tables and sweeps written as the publishers lay them out."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import exp
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.registry import choose_reader, open_recording

START_US = 1_532_402_927_647_951
PERIOD_US = 50_000
T_EGO_LIDAR = exp([0.0, 0.01, -1.57, 0.94, 0.0, 1.84])


def _T_world_ego(index: int) -> np.ndarray:
    return exp([0.0, 0.0, 0.6, 410.0, 1180.0, 0.0]) @ exp(np.multiply(index, [0.0, 0.0, 0.01, 0.4, 0.0, 0.0]))


def _pose(T: np.ndarray) -> dict[str, list[float]]:
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    return {"translation": T[:3, 3].tolist(), "rotation": [w, x, y, z]}


@pytest.fixture
def nuscenes(tmp_path: Path, rng: np.random.Generator) -> SimpleNamespace:
    """Two scenes of six sweeps, every other one a sample; the cameras of each sample are in the tables too."""
    root = tmp_path / "nuscenes"
    tables = root / "v1.0-mini"
    tables.mkdir(parents=True)
    scenes, samples, data, poses, points = [], [], [], [], {}
    for scene in (61, 103):
        scenes.append({"token": f"s{scene}", "name": f"scene-{scene:04d}", "log_token": "l", "nbr_samples": 3})
        for index in range(6):
            stamp, token = START_US + index * PERIOD_US + scene * 10**9, f"{scene}-{index}"
            folder = "sweeps" if index % 2 else "samples"
            name = f"{folder}/LIDAR_TOP/n015-2018-07-24-11-22-45+0800__LIDAR_TOP__{stamp}.pcd.bin"
            cloud = rng.uniform(-40.0, 40.0, (30, 5)).astype("<f4")
            cloud[:, 4] = np.arange(30) % 32
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            cloud.tofile(root / name)
            points[token] = cloud
            if folder == "samples":
                samples.append({"token": f"key{token}", "timestamp": stamp, "scene_token": f"s{scene}"})
            shared = {"sample_token": f"key{scene}-{index - index % 2}", "is_key_frame": folder == "samples"}
            for channel, sensor, T in (("LIDAR_TOP", "lidar", _T_world_ego(index)), ("CAM_FRONT", "camera", np.eye(4))):
                pose, file = f"{channel}pose{token}", name.replace("LIDAR_TOP", channel)
                tokens = {"token": f"{channel}{token}", "ego_pose_token": pose, "calibrated_sensor_token": sensor}
                rest = {"fileformat": "pcd", "height": 0, "prev": "", "next": "", **shared}
                data.append({**tokens, "timestamp": stamp, "filename": file, **rest})
                poses.append({"token": pose, "timestamp": stamp, **_pose(T)})
    rng.shuffle(data)
    sensors = [{"token": "lidar", "sensor_token": "x", **_pose(T_EGO_LIDAR), "camera_intrinsic": []}]
    sensors.append({"token": "camera", "sensor_token": "y", **_pose(np.eye(4)), "camera_intrinsic": [[1.0, 0.0, 0.0]]})
    written = {"scene": scenes, "sample": samples, "sample_data": data, "ego_pose": poses, "calibrated_sensor": sensors}
    for name, records in written.items():
        (tables / f"{name}.json").write_text(json.dumps(records, indent=0))
    return SimpleNamespace(root=root, tables=tables, points=points)


@pytest.mark.parametrize("sequence", ["scene-0061", "61", "0061"])
def test_samples_and_sweeps_of_a_scene_and_the_truth_of_its_lidar(nuscenes: SimpleNamespace, sequence: str) -> None:
    assert choose_reader(nuscenes.root) == "nuscenes"
    recording = open_recording(nuscenes.root, ReaderConfig(sequence=sequence))
    assert (recording.name, len(recording)) == ("nuscenes_scene-0061", 6)
    for index, scan in enumerate(recording.scans()):
        cloud = nuscenes.points[f"61-{index}"]
        np.testing.assert_array_equal(scan.points, cloud[:, :3])
        np.testing.assert_array_equal(scan.rings, cloud[:, 4])
        np.testing.assert_array_equal(scan.intensities, cloud[:, 3])
        assert scan.time_offsets is None
        assert scan.stamp == pytest.approx((START_US + 61 * 10**9 + index * PERIOD_US) * 1e-6)
    expected = [_T_world_ego(index) @ T_EGO_LIDAR for index in range(6)]
    np.testing.assert_allclose(recording.ground_truth.T_world_lidar, expected, atol=1e-9)


def test_the_scene_has_to_be_chosen(nuscenes: SimpleNamespace) -> None:
    with pytest.raises(InputError, match="holds 2 scenes; choose one with --sequence: scene-0061, scene-0103"):
        open_recording(nuscenes.root)
    with pytest.raises(InputError, match="has no scene 'scene-0099'; there are: scene-0061, scene-0103"):
        open_recording(nuscenes.root, ReaderConfig(sequence="scene-0099"))


def test_a_sweep_that_is_not_there_is_left_out(nuscenes: SimpleNamespace) -> None:
    next((nuscenes.root / "sweeps" / "LIDAR_TOP").iterdir()).unlink()
    faults = Faults()
    recordings = (open_recording(nuscenes.root, ReaderConfig(sequence=name)) for name in ("61", "103"))
    assert (sum(len(list(one.scans(faults=faults))) for one in recordings), faults.left_out) == (11, 1)


@pytest.mark.parametrize("place", ["../../outside", "/outside", "samples/../../outside"])
def test_a_sweep_outside_the_data_set_is_not_read(nuscenes: SimpleNamespace, place: str) -> None:
    path = nuscenes.tables / "sample_data.json"
    path.write_text(path.read_text().replace('"filename": "sweeps/', f'"filename": "{place}/'))
    with pytest.raises(InputError, match=r"sample_data\.json: names a sweep outside .*, .*outside/LIDAR_TOP/"):
        open_recording(nuscenes.root, ReaderConfig(sequence="61"))


@pytest.mark.parametrize("part", [0.0, 0.33], ids=["empty", "cut short"])
@pytest.mark.parametrize("table", ["scene", "sample", "sample_data", "ego_pose", "calibrated_sensor"])
def test_a_damaged_table_is_named(nuscenes: SimpleNamespace, table: str, part: float) -> None:
    path = nuscenes.tables / f"{table}.json"
    path.write_bytes(path.read_bytes()[: int(part * path.stat().st_size)])
    with pytest.raises(InputError, match=r"v1\.0-mini"):
        open_recording(nuscenes.root, ReaderConfig(name="nuscenes", sequence="103"))


@pytest.mark.parametrize("text", [b"/LIDAR_TOP/", b"{/LIDAR_TOP/"], ids=["no record", "one record"])
def test_a_table_without_records_is_refused_at_once(nuscenes: SimpleNamespace, text: bytes) -> None:
    """Looked for from every one of a million places, the ends of a record would take hours."""
    table = nuscenes.root / "v1.0-mini" / "sample_data.json"
    table.write_bytes(b"[" + text + b"/LIDAR_TOP/" * 1_000_000 + b"]")
    with pytest.raises(InputError, match="a record has no end within"):
        open_recording(nuscenes.root, ReaderConfig(sequence="0061"))
