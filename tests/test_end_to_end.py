"""The main job, from a recording on disk to a run directory, and what it says about itself."""

import csv
import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import pytest

from lidarslam.config.settings import load_config
from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.geometry import FloatArray, inverse, transform_points
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory, read_kitti_poses, read_tum
from lidarslam.pipeline.estimates import STAGES
from lidarslam.run.request import RunRequest
from lidarslam.run.run import execute
from lidarslam.storage.directory import FILES, MAPS
from lidarslam.storage.finished_run import load_run

from .conftest import write_recording

MAPPING = ["global_map.voxel_size_m=0.1"]
KITTI = ["odometry.method=kiss-icp", "mapping.method=off"]
KISS_ICP = [*KITTI, *MAPPING, "odometry.kiss_icp.voxel_size_m=0.2", "odometry.kiss_icp.max_range_m=30"]


def quiet(*_: object) -> None:
    """No progress bar."""


@pytest.fixture
def recording(tmp_path: Path, room_scans: list[Scan], room_truth: Trajectory) -> Path:
    """The drive through the room as a folder of .npy scans with their times, stamps and ground truth."""
    return write_recording(tmp_path / "room scans", room_scans, room_truth, is_timed=True)


def map_errors(out: Path, room: Any, truth: Trajectory) -> FloatArray:
    """Distances of the points of the map from the surfaces of the room."""
    points = np.asarray(o3d.io.read_point_cloud(str(out / "map.ply")).points)
    return np.asarray(room.distance_to_surface(transform_points(truth.T_world_lidar[0], points)))


def scan_rows(out: Path) -> list[dict[str, str]]:
    with (out / "scans.csv").open() as file:
        return list(csv.DictReader(file))


def test_a_run_writes_what_the_contract_names(recording, tmp_path, room, room_truth):
    out = tmp_path / "run"
    outcome = execute(RunRequest(recording, out, load_config(None, KISS_ICP), map_formats=("pcd",)), quiet)

    trajectory = read_tum(out / "trajectory.tum")
    np.testing.assert_allclose(trajectory.stamps, room_truth.stamps, atol=1e-9)
    truth = inverse(room_truth.T_world_lidar[0]) @ room_truth.T_world_lidar
    assert np.linalg.norm(trajectory.positions - truth[:, :3, 3], axis=1).max() < 0.035
    np.testing.assert_allclose(read_kitti_poses(out / "trajectory.kitti"), trajectory.T_world_lidar, atol=1e-6)
    assert (out / "odometry.tum").read_text() == (out / "trajectory.tum").read_text()

    distance = map_errors(out, room, room_truth)
    assert np.median(distance) < 0.02
    assert np.percentile(distance, 99) < 0.08
    assert len(o3d.io.read_point_cloud(str(out / "map.pcd")).points) == len(distance)

    summary = json.loads((out / "summary.json").read_text())
    assert (summary["scans"], summary["lost_scans"]) == (20, 0)
    assert summary["duration_s"] == pytest.approx(1.9)
    assert summary["length_m"] == pytest.approx(room_truth.length_m, rel=0.02)
    assert (summary["map_points"], summary["map_voxel_size_m"]) == (len(distance), 0.1)
    assert set(summary["ms_per_scan"]) == {"total", *STAGES}
    assert summary["ms_per_scan"]["total"]["p95"] >= summary["ms_per_scan"]["total"]["median"] > 0.0
    assert summary["peak_rss_mb"] > 50.0
    assert all(summary[f"elevation_{key}_deg"] is None for key in ("bias", "sigma", "correction")), "without a mapping"

    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["association"]["matched"] == 20
    assert metrics["trajectory"]["ate_rmse_m"] < 0.02
    assert outcome.metrics is not None

    rows = scan_rows(out)
    assert [float(row["stamp"]) for row in rows] == pytest.approx(room_truth.stamps)
    assert {row["status"] for row in rows} == {"ok"}
    assert not list(out.glob(".partial*"))


def test_what_config_yaml_says_gives_the_same_run_again(recording, tmp_path):
    execute(RunRequest(recording, tmp_path / "a", load_config(None, KISS_ICP), start=2, stop=9, step=2), quiet)
    again = load_config(tmp_path / "a" / "config.yaml")
    execute(RunRequest(recording, tmp_path / "b", again, start=2, stop=9, step=2), quiet)
    first = read_tum(tmp_path / "a" / "trajectory.tum")
    np.testing.assert_allclose(first.stamps, [0.3, 0.5, 0.7, 0.9], atol=1e-9)
    # KISS-ICP adds up its residuals on several threads, in no fixed order.
    second = read_tum(tmp_path / "b" / "trajectory.tum")
    np.testing.assert_allclose(first.T_world_lidar, second.T_world_lidar, atol=1e-6)


def test_by_default_scans_are_laid_on_a_map_and_a_pose_graph_is_built_on_request(recording, tmp_path, room, room_truth):
    """The room is too small for a loop: what the map said stays, and the map drawn from submaps is as exact."""
    out = tmp_path / "run"
    settings = (*MAPPING, "pose_graph.enabled=true", "pose_graph.keyframes.distance_m=0.4")
    outcome = execute(RunRequest(recording, out, load_config(None, settings), rerun="save", report=True), quiet)
    assert outcome.metrics.errors.ate_rmse_m < 0.005
    graph = json.loads((out / "summary.json").read_text())["pose_graph"]
    lines = (out / "pose_graph.g2o").read_text().splitlines()
    assert graph["keyframes"] == sum(line.startswith("VERTEX_SE3:QUAT") for line in lines) >= 3
    assert graph["edges"] == sum(line.startswith("EDGE_SE3:QUAT") for line in lines)
    assert outcome.summary.to_json()["loop_closures"] == 0
    assert np.percentile(map_errors(out, room, room_truth), 95) < 0.02
    assert sorted(path.name for path in out.iterdir()) == sorted(
        {name for name in FILES if "/" not in name} - set(MAPS.values())
    )
    assert not len(load_run(out).loops)
    assert "method: learned" in (out / "config.yaml").read_text()
    assert {row["status"] for row in scan_rows(out)} == {"ok"}
    assert all(float(row["ms_refine"]) > 0.0 for row in scan_rows(out))
    assert all(row["degenerate_directions"] == "" for row in scan_rows(out))


def test_a_covered_sensor_is_reported_as_lost(recording, tmp_path):
    for index in (9, 10):
        table = np.load(recording / f"{index:06d}.npy")
        table["x"] = np.nan
        np.save(recording / f"{index:06d}.npy", table)
    seen: list[Status] = []
    request = RunRequest(recording, tmp_path / "run", load_config(None, KISS_ICP))
    outcome = execute(request, lambda _number, _total, result: seen.append(result.status))
    (stretch,) = outcome.summary.lost
    assert (stretch.first, stretch.last) == (9, 10)
    assert "too few" in stretch.reason
    assert seen[8:11] == [Status.OK, Status.LOST, Status.LOST]
    assert seen[11] in (Status.OK, Status.DEGRADED)
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["lost_scans"] == 2
    assert any("18,000 invalid points" in warning for warning in summary["warnings"])


def test_damage_that_no_scan_can_be_left_out_for_ends_the_run_with_what_there_is(recording, tmp_path, monkeypatch):
    from lidarslam.datasets.folders.scan_folder import ScanFolderRecording

    read = ScanFolderRecording.scans

    def broken(self: Any, *chosen: Any, **options: Any) -> Any:
        yield from list(read(self, *chosen, **options))[:12]
        raise InputError("the disk broke")

    monkeypatch.setattr(ScanFolderRecording, "scans", broken)
    outcome = execute(RunRequest(recording, tmp_path / "run", load_config(None, KISS_ICP)), quiet)
    assert outcome.stopped == "the disk broke"
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["scans"] == 12
    assert len(read_tum(tmp_path / "run" / "trajectory.tum")) == summary["scans"]
    assert (tmp_path / "run" / "map.ply").exists()
    assert "stopped after 12 scans: the disk broke" in summary["warnings"]


def test_a_damaged_truth_costs_the_metrics_not_the_run(recording, tmp_path):
    (recording / "ground_truth.tum").write_text("1 2 3\n")
    outcome = execute(RunRequest(recording, tmp_path / "run", load_config(None, KISS_ICP), stop=4), quiet)
    assert outcome.metrics is None
    assert any("ground_truth.tum:1" in warning for warning in outcome.summary.warnings)
    assert not (tmp_path / "run" / "metrics.json").exists()


def test_a_run_that_cannot_start_leaves_everything_as_it_was(recording, tmp_path):
    before = sorted(recording.iterdir())
    with pytest.raises(OutputError, match="is the recording itself"):
        execute(RunRequest(recording, recording, load_config(None, KISS_ICP), overwrite=True), quiet)
    assert sorted(recording.iterdir()) == before
    for scan in recording.glob("*.npy"):
        scan.write_bytes(b"not an array")
    with pytest.raises(InputError, match=r"\.npy"):
        execute(RunRequest(recording, tmp_path / "run", load_config(None, KISS_ICP)), quiet)
    assert not (tmp_path / "run").exists()


def test_a_rerun_recording_holds_the_run(recording, tmp_path):
    from rerun.chunk import RrdReader

    out = tmp_path / "run"
    config = load_config(None, [*KISS_ICP, "viewer.map_every=5"])
    execute(RunRequest(recording, out, config, rerun="save", stop=11), quiet)
    reader = RrdReader(out / "recording.rrd")
    rows: Counter[str] = Counter()
    for chunk in reader.stream():
        rows[chunk.entity_path] += 0 if chunk.is_static else chunk.num_rows
    assert rows["/world/lidar"] == rows["/world/lidar/scan"] == rows["/plots/ms"] == 11
    assert rows["/plots/inliers"] == rows["/world/trajectory"] == 10
    # After scans 5 and 10, and as it is written; after the first only if the second has been added meanwhile.
    assert rows["/world/map"] in (3, 4)
    assert "/world/ground_truth" in rows
    assert len(reader.blueprints()) == 1


@pytest.mark.real_data
def test_kitti_odometry_is_as_accurate_as_kiss_icps_own_pipeline(real_data, tmp_path):
    from kiss_icp.config import load_config as kiss_config
    from kiss_icp.datasets.kitti import KITTIOdometryDataset
    from kiss_icp.kiss_icp import KissICP
    from kiss_icp.metrics import absolute_trajectory_error

    source = real_data / "kitti_odometry_04"
    files = KITTIOdometryDataset(source, "04")
    library, poses = KissICP(kiss_config(None)), []
    for index in range(len(files)):
        library.register_frame(*files[index])
        poses.append(library.last_pose)
    _, expected_m = absolute_trajectory_error(files.gt_poses[: len(files)], np.array(poses))
    outcome = execute(RunRequest(source, tmp_path / "run", load_config(None, [*KITTI, "reader.sequence='04'"])), quiet)
    assert abs(outcome.metrics.errors.ate_rmse_m - expected_m) < 0.002
    assert outcome.summary.lost_scans == 0
    camera_poses = read_kitti_poses(tmp_path / "run" / "trajectory.kitti")
    truth = read_kitti_poses(source / "poses" / "04.txt")[: len(camera_poses)]
    assert np.linalg.norm(camera_poses[-1, :3, 3] - truth[-1, :3, 3]) < 0.5, "both in the camera frame"
