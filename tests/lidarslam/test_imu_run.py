"""`lidarslam run` with a recording's IMU: whether it helps, what it needs, and that it changes nothing unasked."""

import json
import re
import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lidarslam
from lidarslam.config.settings import load_config
from lidarslam.core.errors import ConfigError, InputError, LidarSlamError
from lidarslam.core.geometry import FloatArray, exp, inverse, make_transform, rotation_angle
from lidarslam.core.trajectory import Trajectory, read_tum
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.registry import open_recording
from lidarslam.run.calibration import unused_imu
from lidarslam.simulation.imu import MEMS_IMU, sample_imu

from ..conftest import succeeds, write_recording
from .conftest import refused, summary_of

SCANS = 20
MODEL = replace(MEMS_IMU, T_lidar_imu=make_transform(exp([0.2, -0.1, 1.4, 0.0, 0.0, 0.0])[:3, :3], [0.05, 0.0, -0.1]))
ANGLES_DEG = Rotation.from_matrix(MODEL.T_lidar_imu[:3, :3]).as_euler("xyz", degrees=True).tolist()
FAST = ("--no-report", "--set", "mapping.keypoints=800", "--set", "global_map.voxel_size_m=0.2")


def shaken(times: FloatArray) -> FloatArray:
    """Poses (N, 4, 4) at times (N,): a loop through the room, shaken within each sweep and turned about all axes."""
    t = np.asarray(times, dtype=np.float64)
    x = 0.2 * np.sin(4.1 * t) + 0.03 * np.sin(29 * t)
    y = 0.2 * np.sin(5.3 * t)
    z = 0.4 * np.sin(2 * t) + 0.06 * np.sin(23 * t)
    turns = np.stack([x, y, z], axis=-1)
    places = np.stack([2.0 * np.sin(0.9 * t) - 1.0, 0.8 * np.cos(1.1 * t), 0.1 * np.sin(3.0 * t)], axis=-1)
    return make_transform(Rotation.from_rotvec(turns).as_matrix(), places)


def record(folder: Path, room: Any, scans: int = SCANS, mounting: bool = True) -> Path:
    """Sweeps of a shaken sensor with its IMU's samples and the truth."""
    stamps, few = 0.1 * np.arange(1, scans + 1), replace(room, points=4000)
    sweeps = (few.sweep(shaken, float(stamp)) for stamp in stamps)
    write_recording(folder, sweeps, Trajectory(stamps, shaken(stamps)), is_timed=True)
    imu = sample_imu(MODEL, shaken, 0.0, float(stamps[-1]) + 0.2, seed=5)
    rows = np.column_stack([imu.stamps, imu.angular_velocities, imu.accelerations])
    header = "T_lidar_imu: " + " ".join(map(str, MODEL.T_lidar_imu[:3].ravel()))
    np.savetxt(folder / "imu.csv", rows, delimiter=",", header=header if mounting else "")
    return folder


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, room: Any) -> Path:
    return record(tmp_path_factory.mktemp("imu") / "room", room)


@pytest.fixture(scope="module")
def longer(tmp_path_factory: pytest.TempPathFactory, room: Any) -> Path:
    return record(tmp_path_factory.mktemp("imu") / "room", room, scans=40)


def run(source: Path, out: Path, *arguments: str, odometry: str = "imu") -> list[object]:
    return ["run", source, "--out", out, *FAST, "--odometry", odometry, *arguments]


def rotation_error_deg(out: Path, source: Path) -> float:
    """RMS error of the motions' rotations."""
    found, true = (read_tum(path).relative_motions() for path in (out / "trajectory.tum", source / "ground_truth.tum"))
    return float(np.rad2deg(np.sqrt((rotation_angle(inverse(found) @ true) ** 2).mean())))


@pytest.mark.long
def test_shaken_sweeps_are_straightened(recording, tmp_path):
    errors = {}
    for method in ("constant-velocity", "imu"):
        out = tmp_path / method
        said = succeeds(*run(recording, out, odometry=method))
        errors[method] = rotation_error_deg(out, recording)
        assert json.loads((out / "metrics.json").read_text())["association"]["matched"] == SCANS
    assert "corrected" not in said
    assert 5.0 * errors["imu"] < errors["constant-velocity"]
    assert errors["imu"] < 0.15


@pytest.mark.long
def test_an_imu_that_nobody_asks_for_changes_nothing(recording, tmp_path):
    bare = Path(shutil.copytree(recording, tmp_path / "room", ignore=shutil.ignore_patterns("imu.csv")))
    texts = []
    for source, out in ((recording, tmp_path / "with"), (bare, tmp_path / "without")):
        succeeds(*run(source, out, "--stop", "8", odometry="constant-velocity"))
        texts.append([(out / file).read_bytes() for file in ("trajectory.tum", "map.ply", "odometry.tum")])
    assert texts[0] == texts[1]


@pytest.mark.parametrize(
    ("settings", "hints"), [([], True), (["odometry.method=imu"], False), (["mapping.method=off"], False)]
)
def test_a_hint_at_an_imu_that_is_there_and_not_used(recording, small_recording, settings, hints):
    config = load_config(None, settings)
    assert (unused_imu(config, open_recording(recording)) is not None) == hints
    assert unused_imu(config, open_recording(small_recording)) is None


@pytest.mark.parametrize("method", ["imu", "learned+imu"])
def test_a_recording_without_an_imu_is_refused_in_one_line(method, small_recording, tmp_path):
    said = refused(*run(small_recording, tmp_path / "run", odometry=method))
    assert f"has no IMU, for --odometry {method}; choose --odometry learned" in said
    assert not (tmp_path / "run").exists()


def test_an_imu_needs_a_map(recording, tmp_path):
    said = refused(*run(recording, tmp_path / "run", "--no-mapping"))
    assert "odometry.method=imu needs scan-to-map registration" in said


@pytest.mark.long
def test_the_mounting_is_found_where_the_recording_has_none_and_can_be_given_to_other_runs(room, tmp_path):
    source = record(tmp_path / "room", room, scans=115, mounting=False)
    succeeds(*run(source, tmp_path / "run"))
    assert rotation_error_deg(tmp_path / "run", source) < 0.2
    (told,) = (warning for warning in summary_of(tmp_path / "run")["warnings"] if "--set" in warning)
    given = shlex.split(told[told.index("--set") :])
    odometry = load_config(None, given[1::2]).odometry
    np.testing.assert_allclose(odometry.imu_rotation_deg, ANGLES_DEG, atol=1.0)
    np.testing.assert_allclose(odometry.imu_position_m, MODEL.T_lidar_imu[:3, 3], atol=0.05)
    assert "--set" not in succeeds(*run(source, tmp_path / "given", "--stop", "20", *given))


@pytest.mark.long
def test_an_unknown_mounting_is_not_guessed_but_may_be_given(room, tmp_path):
    source = record(tmp_path / "room", room, mounting=False)
    said = refused(*run(source, tmp_path / "guess"))
    assert "the extrinsic rotation of its IMU is not recorded, and not observable (only 15 turns could be" in said
    succeeds(*run(source, tmp_path / "given", "--set", f"odometry.imu_rotation_deg={ANGLES_DEG}"))
    assert rotation_error_deg(tmp_path / "given", source) < 0.2


def flawed(recording: Path, folder: Path, flaw: Callable[[FloatArray], FloatArray]) -> Path:
    """The recording with other samples of the IMU."""
    shutil.copytree(recording, folder)
    file = folder / "imu.csv"
    header = file.read_text().partition("\n")[0].removeprefix("# ")
    np.savetxt(file, flaw(np.loadtxt(file, delimiter=",")), delimiter=",", header=header)
    return folder


def late(recording: Path, folder: Path) -> Path:
    """With stamps of the IMU that are 20 ms late."""
    return flawed(recording, folder, lambda rows: rows + np.eye(7)[0] * 0.02)


@pytest.mark.long
def test_a_late_clock_is_corrected(longer, tmp_path):
    said = succeeds(*run(late(longer, tmp_path / "late"), tmp_path / "run"))
    assert re.search(r"the IMU's stamps are (1[7-9]|2[0-3]) ms late; corrected", said), said
    assert rotation_error_deg(tmp_path / "run", longer) < 0.15


@pytest.mark.parametrize(
    ("flaw", "words"),
    [
        (lambda rows: rows + np.eye(7)[0] * 1.7e9, "on another clock than the scans"),
        (lambda rows: rows * [1e3, 1, 1, 1, 1, 1, 1], "check the unit of its stamps"),
        (lambda rows: rows * [1, -1, -1, -1, 1, 1, 1], "the LiDAR about x, y, z are -x, -y, -z of the gyroscope"),
    ],
)
def test_samples_of_another_time_or_a_reversed_gyroscope_are_refused_in_one_line(longer, tmp_path, flaw, words):
    assert words in refused(*run(flawed(longer, tmp_path / "other", flaw), tmp_path / "run"))
    assert not (tmp_path / "run" / "trajectory.tum").exists()


@pytest.mark.long
def test_in_a_finished_map_the_imu_takes_part(longer, tmp_path):
    out, found = tmp_path / "run", tmp_path / "found"
    succeeds(*run(longer, out))
    succeeds("localise", longer, "--map", out, "--out", found, "--odometry", "imu", "--guess", 0, 0, 0, *FAST)
    assert rotation_error_deg(found, longer) < 0.15


def register_all(slam: Any, source: Path, has_samples: bool = True) -> None:
    """Give a recording's samples and scans to a program's own loop, each when it is complete."""
    recording = open_recording(source)
    imu = recording.imu
    rows = list(zip(imu.stamps, imu.angular_velocities, imu.accelerations, strict=True)) if has_samples else []
    for scan in recording.scans(faults=Faults()):
        while rows and rows[0][0] < scan.stamp + scan.time_offsets.max():
            slam.register_imu(*rows.pop(0))
        slam.register_frame(scan)


@pytest.mark.parametrize("is_given", [True, False])
def test_a_programs_own_loop_takes_the_samples_as_they_come(longer, is_given):
    given = {"imu_rotation_deg": ANGLES_DEG, "imu_position_m": MODEL.T_lidar_imu[:3, 3].tolist()} if is_given else {}
    with lidarslam.Slam({"odometry": {"method": "imu", **given}, "mapping.keypoints": 800}) as slam:
        register_all(slam, longer)
        trajectory = slam.trajectory()
    motions = trajectory.relative_motions()[0 if is_given else 32 :]
    true = read_tum(longer / "ground_truth.tum").relative_motions()[-len(motions) :]
    assert np.rad2deg(np.sqrt((rotation_angle(inverse(motions) @ true) ** 2).mean())) < 0.15


@pytest.mark.long
def test_a_late_clock_is_corrected_on_the_way(longer, tmp_path):
    odometry = {"method": "imu", "imu_rotation_deg": ANGLES_DEG}
    with lidarslam.Slam({"odometry": odometry, "mapping.keypoints": 800}) as slam:
        register_all(slam, late(longer, tmp_path / "late"))
        slam.save(tmp_path / "run")
    warnings = summary_of(tmp_path / "run")["warnings"]
    assert any(re.search(r"stamps are (1[6-9]|2[0-4]) ms late; corrected", warning) for warning in warnings), warnings


def test_samples_are_checked(tmp_path):
    with lidarslam.Slam({"odometry.method": "imu"}) as slam:
        slam.register_imu(1.0, [0.0, 0.0, 0.0], [0.0, 0.0, 9.8])
        for stamp, rates, why in (
            (1.0, [0.0, 0.0, 0.0], "stamps must increase"),
            (2.0, [0.0, np.nan, 0.0], "gyroscope must be three finite numbers"),
            (2.0, [0.0, 0.0], "gyroscope must be three finite numbers"),
            (np.inf, [0.0, 0.0, 0.0], "stamp must be a finite number"),
        ):
            with pytest.raises(InputError, match=why):
                slam.register_imu(stamp, rates, [0.0, 0.0, 9.8])
    with pytest.raises(LidarSlamError, match="this Slam is closed"):
        slam.register_imu(3.0, [0.0, 0.0, 0.0], [0.0, 0.0, 9.8])
    with lidarslam.Slam() as slam, pytest.raises(ConfigError, match=r"choose odometry.method=learned\+imu"):
        slam.register_imu(1.0, [0.0, 0.0, 0.0], [0.0, 0.0, 9.8])


@pytest.mark.long
def test_without_samples_scans_are_registered_all_the_same(longer, tmp_path):
    with lidarslam.Slam({"odometry.method": "imu", "mapping.keypoints": 800}) as slam:
        register_all(slam, longer, has_samples=False)
        slam.save(tmp_path / "run")
    assert "no sample of the IMU came" in summary_of(tmp_path / "run")["warnings"]
