"""The interface for Python programs, on scans of known truth."""

import json
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

import lidarslam
from lidarslam import LidarSlamError, RegisteredScan, Scan, Slam, Status, Trajectory
from lidarslam.config.settings import Config, load_config
from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.geometry import inverse, transform_points
from lidarslam.datasets.mounting import correct_elevation, transform_of
from lidarslam.pipeline.localisation import make_localiser
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.run.run import open_odometry
from lidarslam.storage.finished_run import load_run

# Nothing but NumPy and compiled loops, so that tests are fast.
SETTINGS = {"odometry.method": "constant-velocity", "global_map": {"voxel_size_m": 0.1}}
GRAPH = SETTINGS | {"pose_graph": {"enabled": True, "keyframes.distance_m": 0.4}}


@pytest.fixture
def slam() -> Iterator[Slam]:
    with Slam(SETTINGS) as slam:
        yield slam


def register(slam: Slam, scans: list[Scan]) -> list[RegisteredScan]:
    return [slam.register_frame(scan.points, scan.time_offsets, scan.stamp) for scan in scans]


def map_errors(slam: Slam, room: Any, truth: Trajectory) -> Any:
    return room.distance_to_surface(transform_points(truth.T_world_lidar[0], slam.map().points))


def test_each_pose_is_returned_at_once(slam, room_scans, room_truth):
    results, truth = register(slam, room_scans), room_truth.transformed(inverse(room_truth.T_world_lidar[0]))
    assert [result.stamp for result in results] == [scan.stamp for scan in room_scans]
    assert {result.status for result in results} == {Status.OK}
    positions = np.array([result.T_world_lidar[:3, 3] for result in results])
    assert np.linalg.norm(positions - truth.positions, axis=1).max() < 0.01
    assert results[-1].covariance.shape == (6, 6)
    np.testing.assert_allclose(results[-1].velocity, [0.0, 0.01, 0.3, 0.8, 0.05, 0.0], atol=0.03)
    np.testing.assert_array_equal(slam.trajectory().T_world_lidar, [result.T_world_lidar for result in results])
    results[-1].T_world_lidar[0, 3] += 1.0
    assert abs(slam.trajectory().T_world_lidar[-1, 0, 3] - results[-1].T_world_lidar[0, 3]) > 0.9


def test_a_loop_and_a_run_have_the_same_poses(slam, room_scans):
    """Without an odometry's motion of the following scan there is nothing that a run waits for."""
    config = load_config(None, ["odometry.method=constant-velocity"])
    pipeline = Pipeline(open_odometry(config, None), make_localiser(config), config.global_map)
    of_run = [result.T_world_lidar for result in pipeline.run(room_scans)]
    np.testing.assert_array_equal([result.T_world_lidar for result in register(slam, room_scans)], of_run)


@pytest.mark.long
@pytest.mark.parametrize("method", ["learned", "kiss-icp"])
def test_every_odometry_works_at_once(method, room_scans, room_truth):
    with Slam({"odometry.method": method, "odometry.kiss_icp.voxel_size_m": 0.2}) as slam:
        register(slam, room_scans)
        metrics = lidarslam.evaluate(slam.trajectory(), room_truth)
    assert metrics["trajectory"]["ate_rmse_m"] < 0.01


def test_the_map_lies_on_the_walls(slam, room, room_scans, room_truth):
    assert len(slam.map()) == len(slam.trajectory()) == 0
    register(slam, room_scans[:1])
    assert len(slam.map()) > 1000, "the first scan is in the map at once"
    register(slam, room_scans[1:])
    cloud = slam.map()
    assert cloud.normals.shape == cloud.points.shape == (len(cloud), 3)
    distance = map_errors(slam, room, room_truth)
    assert np.median(distance) < 0.01
    assert np.percentile(distance, 95) < 0.03


def test_asking_for_the_map_on_the_way_changes_no_pose(room_scans):
    poses = []
    for asks in (False, True):
        with Slam(GRAPH) as slam:
            for number, scan in enumerate(room_scans[:12]):
                slam.register_frame(scan)
                if asks and number % 4 == 1:
                    slam.map()
                    slam.trajectory()
            poses.append((slam.trajectory().T_world_lidar, len(slam.map())))
    np.testing.assert_array_equal(poses[0][0], poses[1][0])
    assert poses[0][1] == poses[1][1]


@pytest.mark.long
@pytest.mark.parametrize("settings", [SETTINGS, GRAPH])
def test_saved_runs_are_like_others(settings, tmp_path, room, room_scans, room_truth):
    out = tmp_path / "run"
    with Slam(settings) as slam:
        register(slam, room_scans[:10])
        slam.save(out)
        assert {result.is_final for result in register(slam, room_scans[10:])} == {settings is SETTINGS}
        with pytest.raises(OutputError, match="replace it with --overwrite"):
            slam.save(out)
        slam.save(str(out), overwrite=True)
        poses, points = slam.trajectory().T_world_lidar, len(slam.map())
        assert np.percentile(map_errors(slam, room, room_truth), 95) < 0.03
    assert {path.name for path in out.iterdir()} >= {"config.yaml", "odometry.tum", "map.ply", "scans.csv"}
    run = load_run(out)
    np.testing.assert_allclose(run.trajectory.T_world_lidar, poses, atol=1e-8)
    assert len(run.map_points) == points
    summary = json.loads((out / "summary.json").read_text())
    assert summary["scans"] == 20
    assert summary["warnings"] == []
    assert (out / "pose_graph.g2o").is_file() == (settings is GRAPH)
    assert settings is SETTINGS or summary["pose_graph"]["keyframes"] >= 3
    room_truth.save(tmp_path / "truth.tum")
    metrics = lidarslam.evaluate(out, tmp_path / "truth.tum")
    assert metrics["trajectory"]["ate_rmse_m"] < 0.01
    assert metrics["map"] is None
    assert not (out / "metrics.json").exists(), "nothing is written"


def test_points_as_drivers_give_them(slam, room_scans):
    """Other columns, single precision, no-returns; and the buffer is used again."""
    buffer = np.zeros((len(room_scans[0]) + 3, 5), dtype=np.float32)
    times = np.zeros(len(buffer))
    with Slam(SETTINGS) as plain:
        expected = register(plain, room_scans[:6])
    for scan, same in zip(room_scans, expected, strict=False):
        buffer[:-3, :3], times[:-3] = scan.points, scan.time_offsets
        buffer[-3, :3], buffer[-2, :3], buffer[-1, :3] = np.nan, 0.0, 2e4
        result = slam.register_frame(buffer, times, scan.stamp)
        buffer[:], times[:] = 7.0, 0.3
        np.testing.assert_allclose(result.T_world_lidar, same.T_world_lidar, atol=2e-3)
    assert np.linalg.norm(slam.map().points - [7.0, 7.0, 7.0], axis=1).min() > 0.5


def test_a_fourth_column_is_the_intensity_of_the_map(slam, room_scans):
    for scan in room_scans[:3]:
        left = scan.points[:, 1] > 0.0
        slam.register_frame(np.column_stack([scan.points, np.where(left, 0.75, 0.25)]), scan.time_offsets, scan.stamp)
    cloud = slam.map()
    sides = np.abs(cloud.points[:, 1]) > 0.5
    expected = np.where(cloud.points[sides, 1] > 0.0, 0.75, 0.25)
    np.testing.assert_allclose(cloud.attributes.intensity[sides], expected, atol=1e-6)
    with Slam(SETTINGS) as wider:
        wider.register_frame(np.column_stack([room_scans[0].points, np.ones((len(room_scans[0]), 2))]))
        assert wider.map().attributes.intensity is None


def test_arrays_are_corrected_as_the_settings_of_the_reader_say(room_scans):
    reader = {"time_scale": 0.1, "elevation_correction_deg": 2.0, "mounting": "upside-down"}
    R_upright_recorded = transform_of("upside-down")[:3, :3]
    with Slam(SETTINGS) as plain, Slam(SETTINGS | {"reader": reader}) as corrects:
        for scan in room_scans[:4]:
            expected = plain.register_frame(scan)
            recorded = correct_elevation(scan.points @ R_upright_recorded, -2.0)
            found = corrects.register_frame(recorded, 10.0 * scan.time_offsets, scan.stamp)
            np.testing.assert_allclose(found.T_world_lidar, expected.T_world_lidar, atol=1e-6)
        as_it_is = corrects.register_frame(room_scans[4])
        np.testing.assert_allclose(as_it_is.T_world_lidar, plain.register_frame(room_scans[4]).T_world_lidar, atol=1e-6)


def test_clouds_of_open3d_go_in_and_out(slam, room_scans):
    import open3d as o3d

    for scan in room_scans[:3]:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(scan.points))
        result = slam.register_frame(cloud, scan.time_offsets, scan.stamp)
    assert result.status is Status.OK
    found = slam.map()
    np.testing.assert_array_equal(np.asarray(found.to_open3d().points), found.points)


def test_without_stamps_scans_come_at_the_rate(room_scans):
    with Slam(SETTINGS | {"reader.rate_hz": 20}) as slam:
        stamps = [slam.register_frame(scan.points).stamp for scan in room_scans[:3]]
        assert stamps == [0.0, 0.05, 0.1]
        with pytest.raises(InputError, match="with every scan or with none"):
            slam.register_frame(room_scans[3].points, stamp=0.4)


POINTS = np.random.default_rng(1).uniform(1.0, 9.0, (60, 3))


@pytest.mark.parametrize(("points", "times", "stamp", "told"), [
    (np.zeros((5, 2)), None, 0.2, r"must be \(N, 3\).* \(5, 2\)"), (POINTS.T, None, 0.2, r"\(3, 60\); give points\.T"),
    (np.zeros(5, dtype=[("x", "f4"), ("y", "f4")]), None, 0.2, "points must be numbers"),
    (np.array([["a", "b", "c"]]), None, 0.2, "must be numbers"), (POINTS, np.zeros(7), 0.2, "7 for 60 points"),
    (POINTS, np.full(60, 1.7e9), 2.0, "subtract the stamp"),
    (POINTS, np.linspace(0, 1e8, 60), 2.0, "nanoseconds by 1e-9"),
    (POINTS, np.linspace(0, 1, 60), 0.2, "multiply times from 0 to 1"),
    (POINTS, None, 0.1, "is not after the scan before, 0.100000000 s"),
    (POINTS, None, None, "with every scan or with none"), (POINTS, None, float("nan"), "finite"),
    (POINTS, None, 1_700_000_000_000_000_000, "nanoseconds by 1e-9"), (POINTS, None, "now", "stamp must be numbers"),
    (Scan(POINTS, 0.2), None, 0.2, "give it alone"),
])  # fmt: skip
def test_what_cannot_be_used_is_refused_and_changes_nothing(slam, room_scans, points, times, stamp, told):
    register(slam, room_scans[:1])
    with pytest.raises(InputError, match=told):
        slam.register_frame(points, times, stamp)
    assert len(slam.trajectory()) == 1
    (result,) = register(slam, room_scans[1:2])
    assert result.status is Status.OK


def test_a_scan_without_points_is_lost_and_the_next_is_not(slam, room_scans):
    register(slam, room_scans[:5])
    assert slam.register_frame(np.empty((0, 3)), stamp=0.6).status is Status.LOST
    assert slam.register_frame([], stamp=0.65).message
    assert register(slam, room_scans[6:7])[0].status is Status.OK


@pytest.mark.parametrize("error", [RuntimeError("no more memory"), KeyboardInterrupt()])
def test_after_a_break_the_results_so_far_can_be_saved(slam, tmp_path, room_scans, monkeypatch, error):
    register(slam, room_scans[:3])
    monkeypatch.setattr(slam._odometry, "estimate", Mock(side_effect=error))
    with pytest.raises(type(error)):
        register(slam, room_scans[3:])
    with pytest.raises(LidarSlamError, match=r"broken off \((no more memory|KeyboardInterrupt)\)"):
        slam.register_frame(room_scans[10])
    assert len(slam.trajectory()) == 3
    slam.save(tmp_path)
    assert len(load_run(tmp_path).trajectory) == 3


def test_an_error_in_the_background_is_raised_once(slam, room_scans):
    register(slam, room_scans[:3])
    slam.trajectory()
    slam._pipeline.map.thin = None
    slam.register_frame(room_scans[3])
    with pytest.raises(LidarSlamError, match="building the map failed: TypeError"):
        slam.map()
    with pytest.raises(LidarSlamError, match="broken off"):
        slam.register_frame(room_scans[4])
    assert len(slam.trajectory()) == 3


def test_closed_is_closed(room_scans, tmp_path):
    before = threading.active_count()
    with Slam(GRAPH) as slam:
        register(slam, room_scans[:2])
    slam.close()
    assert threading.active_count() == before
    for call in (lambda: slam.register_frame(room_scans[2]), slam.map, slam.trajectory, lambda: slam.save(tmp_path)):
        with pytest.raises(LidarSlamError, match="is closed"):
            call()


def test_configurations_of_every_form_and_nothing_is_saved_of_nothing(tmp_path):
    file = tmp_path / "my.yaml"
    file.write_text("odometry: {method: constant-velocity}\n")
    for given in (file, str(file), SETTINGS, load_config(file), "indoor"):
        with Slam(given) as slam, pytest.raises(InputError, match="nothing to save"):
            slam.save(tmp_path / "run")
        assert slam._config != Config()
    assert not (tmp_path / "run").exists()


def test_a_recording_is_a_sequence_of_scans(recording, tmp_path, room_scans, room_truth):
    recording = shutil.copytree(recording, tmp_path / "room")
    opened = lidarslam.open(recording, stop=4)
    assert len(opened) == len(list(opened)) == 4
    for scan, written in zip(opened, room_scans, strict=False):
        np.testing.assert_allclose(scan.points, written.points)
        assert scan.stamp == pytest.approx(written.stamp)
    assert opened.name == "room"
    np.testing.assert_allclose(opened.ground_truth.T_world_lidar, room_truth.T_world_lidar, atol=1e-8)
    (recording / "000002.npy").write_bytes(b"")
    assert len(list(opened)) == 3
    assert any("left out" in warning for warning in opened.warnings)
    with pytest.raises(InputError, match="no such file"):
        lidarslam.open(recording / "elsewhere")


def test_evaluate_takes_trajectories_files_and_recordings(recording, tmp_path, room_truth):
    moved = Trajectory(room_truth.stamps, room_truth.T_world_lidar.copy())
    moved.T_world_lidar[:, 0, 3] += np.where(np.arange(20) % 2, 0.01, -0.01)
    moved.save(tmp_path / "moved.tum")
    for estimate in (moved, tmp_path / "moved.tum", str(tmp_path / "moved.tum")):
        for reference in (room_truth, recording):
            metrics = lidarslam.evaluate(estimate, reference)
            assert metrics["trajectory"]["ate_rmse_m"] == pytest.approx(0.01, rel=0.05)
            assert metrics["association"]["matched"] == 20
    with pytest.raises(InputError, match="no reference"):
        lidarslam.evaluate(moved)


def test_the_root_loads_nothing_before_it_is_used():
    code = (
        "import sys; before = set(sys.modules); import lidarslam; dir(lidarslam)\n"
        "print(sorted(name for name in set(sys.modules) - before if name.startswith(('lidarslam', 'numpy'))))\n"
        "lidarslam.Trajectory; print(sorted({'torch', 'open3d', 'gtsam', 'numba'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["['lidarslam']", "[]"]


def test_the_names_are_those_that_are_said():
    assert set(lidarslam._MODULES) == set(lidarslam.__all__) <= set(dir(lidarslam))
    for name in lidarslam.__all__:
        assert getattr(lidarslam, name).__doc__, f"{name} is documented"
    assert lidarslam.__version__.count(".") == 2
    with pytest.raises(AttributeError, match="has no attribute 'slam'"):
        _ = lidarslam.slam
