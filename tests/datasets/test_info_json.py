"""The description of a recording as JSON: what the text has, always under the same keys."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lidarslam.core.scan import Scan
from lidarslam.datasets import info_text
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.info_text import describe_as_json
from lidarslam.datasets.point_table import PointField
from lidarslam.datasets.recording import ImuSummary, RecordingInfo, SeveralTopicsError, Topic
from lidarslam.datasets.times.point_time import PointTimeModel

KEYS = {
    "source", "reader", "topic", "scans", "first_stamp_s", "last_stamp_s", "duration_s", "rate_hz", "first_scan",
    "fields", "point_time", "ground_truth", "imu", "notes", "topics", "topic_choices",
}  # fmt: skip
HAS = dict.fromkeys(("has_intensities", "has_colours", "has_rings"), False)
CLOUDS = Topic("/points", "sensor_msgs/msg/PointCloud2", 3)


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    (tmp_path / "site.bag").touch()
    return tmp_path / "site.bag"


def described(bag: Path, monkeypatch: pytest.MonkeyPatch, info: RecordingInfo | Exception) -> dict[str, Any]:
    class Recording:
        def describe(self) -> RecordingInfo:
            if isinstance(info, Exception):
                raise info
            return info

    monkeypatch.setattr(info_text, "open_recording", lambda *_: Recording())
    text = describe_as_json(bag, ReaderConfig())
    assert text.isascii()
    assert text.replace("\n", "").isprintable()
    return dict(json.loads(text))


def test_all_keys_of_a_bag(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.array([[1.0, 0, 0], [2.0, 0, 0], [0, 0, 0]])
    first = Scan.from_raw(points, 10.0, np.array([-0.05, 0.05, 0.0]), np.array([0, 1, 2]), np.arange(3.0))
    topics = (CLOUDS, Topic("/imu\x7f\x1b", "sensor_msgs/msg/Imu", 40))
    fields = (PointField("x", "float32"), PointField("t", "uint32"))
    times, truth = PointTimeModel("t", "ns", "relative"), bag.with_suffix(".tum")
    imu = ImuSummary("/imu", 40, 200.0, False, ("Another.",))
    info = RecordingInfo("rosbag", 3, first, 10.2, truth, times, "/points", topics, fields, ("A note.",), imu)
    assert described(bag, monkeypatch, info) == {
        "source": str(bag),
        "reader": "rosbag",
        "topic": "/points",
        "scans": 3,
        "first_stamp_s": 10.0,
        "last_stamp_s": 10.2,
        "duration_s": pytest.approx(0.2),
        "rate_hz": pytest.approx(10.0),
        "first_scan": {"points": 2, "dropped_points": 1, **HAS, "has_intensities": True, "has_rings": True},
        "fields": [{"name": "x", "type": "float32"}, {"name": "t", "type": "uint32"}],
        "point_time": {"field": "t", "unit": "ns", "reference": "relative", "first_s": -0.05, "last_s": 0.05},
        "ground_truth": str(bag.with_suffix(".tum")),
        "imu": {"name": "/imu", "samples": 40, "rate_hz": 200.0, "has_extrinsic": False},
        "notes": ["A note.", "Another.", "An IMU is there: run with --odometry learned+imu."],
        "topics": [
            {"name": "/points", "type": "sensor_msgs/msg/PointCloud2", "messages": 3},
            {"name": "/imu\x7f\x1b", "type": "sensor_msgs/msg/Imu", "messages": 40},
        ],
        "topic_choices": [],
    }


def test_what_is_not_there_is_null(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    info = RecordingInfo("scan-folder", 1, Scan.from_raw(np.ones((1, 3)), 5.0), 5.0, None, None)
    content = described(bag, monkeypatch, info)
    nothing = {key for key in KEYS if content[key] is None}
    assert nothing == {"topic", "rate_hz", "point_time", "ground_truth", "imu"}
    several = described(bag, monkeypatch, SeveralTopicsError("several", [CLOUDS, CLOUDS], [CLOUDS, CLOUDS]))
    assert set(several) == set(content) == KEYS
    assert (several["reader"], several["scans"], several["topic_choices"]) == ("rosbag", None, ["/points"] * 2)


def test_the_keys_are_documented() -> None:
    page = (Path(__file__).parents[2] / "docs" / "command_line.md").read_text()
    assert [key for key in KEYS if f"`{key}`" not in page] == []
