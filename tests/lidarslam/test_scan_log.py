"""What is kept and said of a run: its log, its summary, what it was made with, and its progress bar."""

import io
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lidarslam.compare import comparison as described
from lidarslam.compare.comparison import versions
from lidarslam.core.geometry import exp
from lidarslam.core.tracking import AXES, Status
from lidarslam.pipeline.estimates import STAGES, ScanEstimate
from lidarslam.run.progress import show_progress
from lidarslam.run.results import format_times
from lidarslam.run.summary import Milliseconds, ScanLog, SlowestScan, WrittenMap, summarise

from .conftest import scan_estimate


def result(stamp: float, status: Status = Status.OK, **values: Any) -> ScanEstimate:
    given = {
        "T_world_lidar": exp(np.full(6, 0.1 * stamp)),
        "T_odom_lidar": exp(np.full(6, 0.2 * stamp)),
        "residual_m": 0.0123456,
        "stage_ms": {"read": 1.234, "map": 2.0},
    }
    return scan_estimate(stamp, status=status, **given | values)


@pytest.fixture
def log() -> ScanLog:
    log = ScanLog()
    log.add(result(1.0, covariance=np.diag([1e-6, 4e-6, 9e-6, 1e-4, 4e-4, 1.0])), total_ms=10.0)
    log.add(result(2.5, Status.LOST, message="no points, none", degenerate=("x", "yaw"), residual_m=None), 20.0)
    log.warn("twice")
    log.warn("twice")
    return log


def test_the_table_has_a_row_a_scan(log):
    assert log.format_csv().splitlines()[1:] == [
        "0,1.000000000,ok,100,1,90,0.0123,,,0.001,0.002,0.003,0.01,0.02,1,1,1.23,0.00,0.00,0.00,0.00,2.00,",
        '1,2.500000000,lost,100,1,90,,,x yaw,,,,,,,1,1.23,0.00,0.00,0.00,0.00,2.00,"no points, none"',
    ]


def test_the_elapsed_time_per_scan_agrees_with_that_of_all_scans_where_most_gaps_are_short():
    log = ScanLog()
    for stamp, total_ms in enumerate([0.0, 0.0, 0.0, 0.0, 400.0]):
        log.add(result(float(stamp), stage_ms={"odometry": 30.0, "refine": 50.0}), total_ms)
    summary = summarise(log, WrittenMap(1, 0.1, 0), unreadable=0)
    assert (summary.elapsed_s, summary.elapsed_ms_per_scan) == (0.4, 80.0)
    assert summary.latency_ms == Milliseconds(80.0, 80.0, 80.0)
    lines = list(format_times(summary))
    assert lines[0].startswith("0.4 s for all scans, 80.0 ms per scan, 10.0 times faster than recorded; ")
    assert lines[1].startswith("latency of one scan: median 80 ms, 99 % under 80 ms; slowest: scan 1, 50 ms of refine")
    json = summary.to_json()
    assert (json["elapsed_ms_per_scan"], json["latency_ms"]["p99"]) == (80.0, 80.0)
    assert json["ms_per_scan"]["total"]["median"] == 0.0
    assert json["slowest_scan"] == {"scan": 1, "stage": "refine", "ms": 50.0}


def test_the_slowest_stage_is_not_that_of_the_first_scan_which_loads_loops():
    stage_ms = np.full((4, len(STAGES)), 2.0)
    stage_ms[0], stage_ms[2, STAGES.index("refine")] = 900.0, 77.0
    assert SlowestScan.of(stage_ms) == SlowestScan(2, "refine", 77.0)
    assert SlowestScan.of(stage_ms[:1]) is None


def test_a_warning_is_kept_once_and_a_correction_leaves_the_odometry(log):
    assert log.warnings == ["twice"]
    log.correct(np.tile(np.eye(4), (2, 1, 1)))
    np.testing.assert_array_equal(log.trajectory.positions, np.zeros((2, 3)))
    np.testing.assert_array_equal(log.odometry.T_world_lidar[1], exp(np.full(6, 0.5)))


def test_a_restored_log_goes_on_alike(log):
    restored = ScanLog()
    restored.restore(log.state())
    for one in (log, restored):
        one.add(result(3.0))
    assert restored.format_csv() == log.format_csv()
    np.testing.assert_array_equal(restored.trajectory.T_world_lidar, log.trajectory.T_world_lidar)


def test_a_walking_speed_is_missing_where_nothing_is_known_of_the_motion():
    log = ScanLog()
    for scan in range(21):
        log.add(result(0.1 * scan, degenerate=AXES if scan in (1, 2) else ()))
    summary = summarise(log, WrittenMap(0, None, 0), unreadable=0)
    assert summary.to_json()["unconstrained_m"] == pytest.approx(0.3)


@pytest.mark.parametrize(("sigma_m", "unconstrained_m"), [(0.2, 2.0), (0.05, 0.0)])
def test_motions_shorter_than_their_standard_deviation_may_be_noise(sigma_m, unconstrained_m):
    """Twenty of ten centimetres along x; whatever the deviation along z, which they leave alone."""
    log = ScanLog()
    for scan in range(21):
        pose = exp([0.0, 0.0, 0.0, 0.1 * scan, 0.0, 0.0])
        log.add(result(0.1 * scan, T_world_lidar=pose, covariance=np.diag([1e-6] * 3 + [sigma_m**2, 1e-4, 1.0])))
    summary = summarise(log, WrittenMap(0, None, 0), unreadable=0)
    assert summary.to_json()["unconstrained_m"] == pytest.approx(unconstrained_m)


@pytest.mark.parametrize(("noise_m", "sigma_m"), [(0.05, 0.05), (0.05, 0.005), (0.005, 0.05)])
def test_noise_that_lengthens_a_path_is_measured(noise_m, sigma_m):
    """A hundred motions of ten centimetres along x; a sway that is registered well is no noise."""
    log, rng = ScanLog(), np.random.default_rng(0)
    for scan in range(101):
        pose = exp([0.0, 0.0, 0.0, 0.1 * scan, *rng.normal(0.0, noise_m, 2)])
        log.add(result(0.1 * scan, T_world_lidar=pose, covariance=np.diag([1e-6] * 4 + [sigma_m**2] * 2)))
    summary = summarise(log, WrittenMap(0, None, 0), unreadable=0)
    lengthened_m = summary.length_m - 10.0 if noise_m == sigma_m else 0.0
    assert summary.to_json()["unconstrained_m"] == pytest.approx(lengthened_m, rel=0.1, abs=0.11)  # the first motion
    assert summary.went_astray == (noise_m == sigma_m)


@pytest.mark.parametrize("direction", ["x", "yaw"])
@pytest.mark.parametrize(("open_scans", "unknown"), [(0, False), (1, False), (4, True)])
def test_the_way_that_nothing_constrains_is_measured_and_too_much_of_it_is_no_success(open_scans, unknown, direction):
    """Eleven scans a metre apart along x, the last of which hardly constrain it, or not even the rotation."""
    log = ScanLog()
    for scan in range(11):
        pose = exp([0.0, 0.0, 0.5, 0.0, 0.0, 0.0]) @ exp([0.0, 0.0, 0.0, float(scan), 0.0, 0.0])
        degenerate = (direction, "y") if scan > 10 - open_scans else ("z",)
        log.add(result(0.1 * scan, T_world_lidar=pose, degenerate=degenerate))
    summary = summarise(log, WrittenMap(0, None, 0), unreadable=0)
    assert summary.to_json()["unconstrained_m"] == pytest.approx(open_scans, abs=1e-9)
    assert summary.went_astray == unknown
    assert any("is uncertain by" in warning for warning in summary.warnings) == unknown


@pytest.mark.parametrize(("interval_s", "status", "unknown"), [
    (0.5, Status.DEGRADED, True), (0.5, Status.OK, False), (0.05, Status.DEGRADED, False),
])  # fmt: skip
def test_the_length_is_unknown_where_the_first_motion_of_a_slow_recording_is_degraded(interval_s, status, unknown):
    log = ScanLog()
    for scan in range(8):
        log.add(result(interval_s * scan, status=status if scan == 1 else Status.OK))
    assert summarise(log, WrittenMap(0, None, 0), unreadable=0).went_astray == unknown


@pytest.mark.parametrize(("second_m", "unknown"), [(0.1, True), (1.7, False)])
def test_a_first_motion_counts_as_unknown_where_no_vehicle_accelerates_to_the_second(second_m, unknown):
    log = ScanLog()
    for scan, x_m in enumerate(np.cumsum([0.0, 2.0, second_m, 0.1, 0.1, 0.1])):
        log.add(result(0.3 * scan, T_world_lidar=exp([0.0, 0.0, 0.0, x_m, 0.0, 0.0])))
    assert summarise(log, WrittenMap(0, None, 0), unreadable=0).went_astray == unknown


@pytest.mark.parametrize(("jump_m", "scans", "unknown"), [(0.4, 60, False), (2.4, 60, True), (0.0, 1, False)])
def test_jumps_of_the_pose_count_as_unknown(jump_m, scans, unknown):
    """To a place that looks the same, and back; walking speeds else."""
    log = ScanLog()
    for scan in range(scans):
        x_m = 0.1 * scan + jump_m * (20 <= scan < 40)
        log.add(result(0.1 * scan, T_world_lidar=exp([0.0, 0.0, 0.0, x_m, 0.0, 0.0])))
    assert summarise(log, WrittenMap(0, None, 0), unreadable=0).went_astray == unknown


@pytest.mark.parametrize(("unreadable", "lacks"), [(2, False), (3, True)])
def test_a_result_that_lacks_more_than_a_tenth_of_the_scans_is_no_success(unreadable, lacks):
    log = ScanLog()
    for scan in range(18):
        log.add(result(0.1 * scan))
    assert summarise(log, WrittenMap(0, None, 0), unreadable).went_astray == lacks


def test_without_a_terminal_lines_say_how_far_a_run_is(monkeypatch, capsys):
    monkeypatch.setattr("lidarslam.run.progress._LINE_EVERY_S", 0.0)
    with show_progress("site") as progress:
        progress(1, 4, result(0.0))
        progress(2, 4, result(0.1, status=Status.LOST))
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["site: 1 of 4 scans, 0 min left", "site: 2 of 4 scans, 1 lost, 0 min left"]


def test_the_programs_that_results_depend_on_are_named():
    found = versions()
    assert {"lidarslam", "kiss-icp", "numpy", "onnxruntime", "python"} <= set(found)
    assert {"open3d", "open3d-cpu"} & set(found)
    assert all(found.values())


def _git(folder: Path, *arguments: str) -> None:
    names = ("-c", "user.name=n", "-c", "user.email=e@example.org")
    subprocess.run(["git", "-C", str(folder), *names, *arguments], check=True, capture_output=True)


def test_a_checkout_has_a_commit_and_says_that_files_differ(tmp_path, monkeypatch):
    monkeypatch.setattr(described, "__file__", str(tmp_path / "lidarslam" / "compare" / "comparison.py"))
    assert "commit" not in versions()
    _git(tmp_path, "init")
    (tmp_path / "a").write_text("1")
    _git(tmp_path, "add", "a")
    _git(tmp_path, "commit", "-m", "first", "--no-verify")
    commit = versions()["commit"]
    assert len(commit) == 12
    (tmp_path / "a").write_text("2")
    assert versions()["commit"] == f"{commit}-dirty"


def test_before_the_first_scan_the_bar_says_what_goes_on(monkeypatch):
    terminal = io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with show_progress("a[red]b[/nothing]") as progress:
        progress.phase("compiling loops")
    assert "compiling loops" in terminal.getvalue()
    assert "a[red]b[/nothing]" in terminal.getvalue()


@pytest.mark.parametrize(("moved", "step_m", "wrong"), [(40, 0.1, True), (15, 0.1, False), (40, 0.002, False)])
def test_a_moving_sensor_that_sees_through_its_map_has_wrong_poses(moved, step_m, wrong):
    log = ScanLog()
    for scan in range(20):
        log.add(result(0.1 * scan, T_world_lidar=exp([0.0, 0.0, 0.0, step_m * scan, 0.0, 0.0])))
    summary = summarise(log, WrittenMap(100 - moved, 0.1, moved), unreadable=0)
    assert summary.went_astray == wrong
    assert any("see through" in warning for warning in summary.warnings) == wrong
