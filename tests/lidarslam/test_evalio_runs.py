"""A sequence named as evalio names it: a drive through the room in the layout of Hilti 2022."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

import lidarslam
from lidarslam.core.geometry import FloatArray
from lidarslam.datasets.ros.made_messages import POINT_CLOUD2_TYPE, header, point_cloud, vector

from ..conftest import succeeds

SOURCE = "evalio:hilti_2022/basement_2"
START_NS = 1_640_000_000 * 10**9
SCANS = 8
POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "timestamp", "ring"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<f8", "<u2"],
        "offsets": [0, 4, 8, 16, 24, 32],
        "itemsize": 48,
    }
)
IMU = "sensor_msgs/msg/Imu"


def _write_bag(path: Path, room: Any, drive: Callable[[FloatArray], FloatArray]) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer(path) as writer:
        clouds = writer.add_connection("/hesai/pandar", POINT_CLOUD2_TYPE, typestore=store)
        imu = writer.add_connection("/alphasense/imu", IMU, typestore=store)
        for index in range(SCANS):
            scan = room.ring_sweep(drive, 0.1 * index + 0.05)
            stamp_ns = START_NS + index * 10**8
            table = np.zeros(len(scan), POINT)
            table["x"], table["y"], table["z"] = scan.points.T
            table["timestamp"] = stamp_ns * 1e-9 + scan.time_offsets + 0.05
            table["ring"] = scan.rings
            cloud = point_cloud(store, header(store, stamp_ns, "PandarXT-32"), table)
            writer.write(clouds, stamp_ns, store.serialize_ros1(cloud, cloud.__msgtype__))
            sample = store.types[IMU](
                header=cloud.header,
                orientation=store.types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
                orientation_covariance=np.zeros(9),
                angular_velocity=vector(store, np.zeros(3)),
                angular_velocity_covariance=np.zeros(9),
                linear_acceleration=vector(store, np.array([0.0, 0.0, 9.81])),
                linear_acceleration_covariance=np.zeros(9),
            )
            writer.write(imu, stamp_ns, store.serialize_ros1(sample, sample.__msgtype__))


@pytest.fixture
def sequence(
    empty_folder: Path, monkeypatch: pytest.MonkeyPatch, room: Any, drive: Callable[[FloatArray], FloatArray]
) -> Path:
    """The folder of the sequence in evalio's default place; the current folder is empty but for that."""
    pytest.importorskip("evalio")
    monkeypatch.delenv("EVALIO_DATA", raising=False)
    folder = empty_folder / "evalio_data" / "hilti_2022" / "basement_2"
    folder.mkdir(parents=True)
    _write_bag(folder / "exp14_basement_2.bag", room, drive)
    lines = [f"{START_NS // 10**9}.{hundredth:02d} 0 0 0 0 0 0 1\n" for hundredth in range(10 * SCANS + 5)]
    (folder / "exp14_basement_2_imu.txt").write_text("".join(lines))
    return folder


def test_info_and_python_know_the_name(sequence):
    known = json.loads(succeeds("info", SOURCE, "--json"))
    assert (known["reader"], known["scans"], known["source"]) == ("evalio", SCANS, str(sequence))
    assert known["first_scan"]["has_rings"]
    assert known["point_time"]["last_s"] == pytest.approx(0.1, abs=1e-3)
    recording = lidarslam.open(SOURCE, stop=2)
    assert len(list(recording)) == len(recording) == 2
    assert recording.ground_truth is not None
