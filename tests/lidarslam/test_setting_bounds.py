"""Bounds of settings: values beyond are refused with them, and at them a run is right, or says that it is not."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from lidarslam.config.settings import Config, TrainConfig, bounds_of, bounds_text, load_config
from lidarslam.core.errors import ConfigError
from lidarslam.core.geometry import inverse, transform_points
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import read_tum
from lidarslam.datasets.folders.scan_files import read_ply

from ..conftest import lidarslam, write_recording


def settings_of(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    for name, field in model.model_fields.items():
        kinds = (field.annotation, *get_args(field.annotation))
        section = next((kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel)), None)
        if section is None:
            yield f"{prefix}{name}", field
        else:
            yield from settings_of(section, f"{prefix}{name}.")


SETTINGS = dict(settings_of(Config))
NUMBERS = {name: field for name, field in SETTINGS.items() if bounds_of(field)}
EXTREMES = [(name, bound) for name, field in NUMBERS.items() for bound in bounds_of(field) or ()]
# What a setting needs to have an effect, or a value beside it that goes with the extreme one.
NEEDED = {
    "odometry.kiss_icp.": ["odometry.method=kiss-icp", "mapping.method=off"],
    "mapping.prior_": ["odometry.method=kiss-icp"],
    "odometry.imu_position_m": ["odometry.imu_rotation_deg=[0, 0, 0]"],
    "pose_graph.": ["pose_graph.enabled=true", "pose_graph.loops.min_way_m=1"],
}
BESIDE = {
    ("mapping.tracking.degraded_below", 0.0): "mapping.tracking.lost_below=0",
    ("mapping.tracking.lost_below", 1.0): "mapping.tracking.degraded_below=1",
}
# Lists of three numbers.
VECTORS = ("odometry.imu_rotation_deg", "odometry.imu_position_m", "reader.mounting")
# At one of their bounds no point of this recording is left for the map.
MAY_EMPTY = ("global_map.max_range_m",)


def test_there_are_few_settings_and_each_is_described():
    assert len(SETTINGS) <= 61
    assert [name for name, field in SETTINGS.items() if not field.description] == []


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize("value", ["true", "off"])
def test_a_number_is_neither_true_nor_false(name, value):
    if value in map(str, get_args(NUMBERS[name].annotation)):
        pytest.skip("off is one of its values")
    with pytest.raises(ConfigError, match=f"{name}.*: (expected|input should be)"):
        load_config(None, [f"{name}={value}"])


def text_of(name: str, value: float) -> str:
    return f"[{value!r}, 0, 0]" if name in VECTORS else f"{value!r}"


def kinds(annotation: Any) -> list[Any]:
    return [part for kind in get_args(annotation) for part in kinds(kind)] or [annotation]


@pytest.mark.parametrize("name", SETTINGS)
def test_a_value_beyond_the_declared_bounds_is_refused_with_them(name):
    field = SETTINGS[name]
    bounds = bounds_of(field)
    if bounds is None:
        # Not a number: a choice, a switch, or a name.
        assert not {int, float} & set(kinds(field.annotation))
        with pytest.raises(ConfigError, match=f"{name}.*: (input|string|no \\w+) (should|is)"):
            load_config(None, [f"{name}=[[]]" if name.endswith("weights") else f"{name}=''"])
        return
    expected = re.escape(bounds_text(field) or "")
    for bound, outward in zip(bounds, (-np.inf, np.inf), strict=True):
        beyond = np.nextafter(bound, outward) if float in kinds(field.annotation) else bound + np.sign(outward)
        value = text_of(name, beyond.item())
        said = rf"{name}='?{re.escape(repr(beyond.item()))}'?: expected {expected}$"
        with pytest.raises(ConfigError, match=said):
            load_config(None, [*needed(name, bound), f"{name}={value}"])


def needed(name: str, bound: float) -> list[str]:
    return [one for prefix, ones in NEEDED.items() if name.startswith(prefix) for one in ones] + [
        beside for key, beside in BESIDE.items() if key == (name, bound)
    ]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, room_scans: list[Scan]) -> Path:
    scans = [scan.select(np.arange(0, 9000, 3)) for scan in room_scans[:8]]
    return write_recording(tmp_path_factory.mktemp("recordings") / "room", scans, is_timed=True)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "bound"), EXTREMES, ids=lambda value: f"{value}")
def test_at_its_bounds_a_run_is_right_or_says_that_it_is_not(tmp_path, recording, room, room_truth, name, bound):
    settings = ["odometry.method=constant-velocity", *needed(name, bound), f"{name}={text_of(name, bound)}"]
    words = [word for setting in settings for word in ("--set", setting)]
    result = lidarslam("run", recording, "--out", tmp_path / "run", "--no-report", *words)
    if name.endswith("min_range_m") and bound:
        assert (result.exit_code, "or no point is left" in result.stderr) == (1, True)
        return
    assert result.exit_code in (0, 3), result.output
    trajectory = read_tum(tmp_path / "run" / "trajectory.tum")
    assert len(trajectory) == 8
    if result.exit_code == 3:
        return
    truth = inverse(room_truth.T_world_lidar[0]) @ room_truth.T_world_lidar[:8]
    assert np.abs(trajectory.T_world_lidar[:, :3, 3] - truth[:, :3, 3]).max() < 0.2
    # The map lies on the walls, at least one point in four square metres of them.
    if "the map is empty" in result.stdout:
        assert name in MAY_EMPTY
        return
    cloud = read_ply(tmp_path / "run" / "map.ply")
    points = transform_points(room_truth.T_world_lidar[0], np.stack([cloud[axis] for axis in "xyz"], -1).astype(float))
    edge_m = bound if name == "global_map.voxel_size_m" else 0.2
    if name == "reader.elevation_correction_deg":  # which raises the points of the farthest corner by so much
        edge_m += np.linalg.norm(room.half_size) * np.sin(np.deg2rad(abs(bound)))
    assert np.quantile(room.distance_to_surface(points), 0.95) < 0.2 + edge_m
    assert len(points) > (4 if edge_m > 1.0 else 100)


def test_every_number_of_a_training_has_bounds():
    numbers = {name: field for name, field in settings_of(TrainConfig) if {int, float} & set(kinds(field.annotation))}
    assert len(numbers) > 10
    assert [name for name, field in numbers.items() if bounds_of(field) is None] == []
