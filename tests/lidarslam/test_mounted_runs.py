"""Whatever reads a recording of a sensor on its side comes to the results of the upright one."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidarslam.assessment.inputs import truth_of_run
from lidarslam.config.settings import load_config
from lidarslam.core.geometry import FloatArray, inverse, make_transform
from lidarslam.core.trajectory import Trajectory, read_tum
from lidarslam.exports.source import read_run_scans
from lidarslam.run.request import RunRequest
from lidarslam.run.run import execute
from lidarslam.simulation.record import RecordRequest, make_simulation
from lidarslam.simulation.recorder import Simulation
from lidarslam.storage.finished_run import load_map

from ..conftest import succeeds, write_recording

SCANS = 22  # of which the guess looks at every fourth
TURNS = {
    "upright": np.eye(3),
    "rolled": np.round(Rotation.from_euler("x", 90, degrees=True).as_matrix()),
    "camera": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
}
FAST = ["--no-report", "--set", "mapping.keypoints=800", "--set", "global_map.voxel_size_m=0.2"]
CONSTANT = ["--odometry", "constant-velocity"]


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return make_simulation(RecordRequest(Path(), "street", "vlp-16", "handheld", "upright", SCANS, 3, ""))


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory, simulation: Simulation) -> dict[str, Path]:
    """Two of it, of other noise, with an IMU, as recorded in each of the axes: `upright`, `upright again`, ..."""
    root, paths = tmp_path_factory.mktemp("recordings"), dict[str, Path]()
    for again, seed in (("", 3), (" again", 4)):
        made = replace(simulation, seed=seed)
        scans, imu, truth = list(made.scans()), made.imu, made.ground_truth
        rows = np.column_stack([imu.stamps, imu.angular_velocities, imu.accelerations])
        for name, R in TURNS.items():
            T_recorded_lidar = make_transform(R, np.zeros(3))
            turned = Trajectory(truth.stamps, truth.T_world_lidar @ inverse(T_recorded_lidar))
            axes = [replace(scan, points=scan.points @ R.T) for scan in scans]
            paths[name + again] = folder = root / f"{name}{again}".replace(" ", "_")
            write_recording(folder, axes, turned, is_timed=True)
            header = "T_lidar_imu: " + " ".join(map(str, (T_recorded_lidar @ imu.T_lidar_imu)[:3].ravel()))
            np.savetxt(folder / "imu.csv", rows, delimiter=",", header=header)
    return paths


def run(source: Path, out: Path, *words: str) -> Path:
    succeeds("run", source, "-o", out, *FAST, *words)
    return out


def poses(directory: Path) -> FloatArray:
    return read_tum(directory / "trajectory.tum").T_world_lidar


@pytest.fixture(scope="module")
def upright(recordings: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run(recordings["upright"], tmp_path_factory.mktemp("runs") / "upright", *CONSTANT)


def files(directory: Path) -> dict[str, bytes]:
    return {name: (directory / name).read_bytes() for name in ("trajectory.tum", "odometry.tum", "map.ply")}


@pytest.mark.long
def test_results_are_those_of_the_upright_recording(recordings, upright, tmp_path):
    rolled = run(recordings["rolled"], tmp_path / "rolled", *CONSTANT)
    told = run(recordings["rolled"], tmp_path / "told", *CONSTANT, "--set", "reader.mounting=left")
    for directory in (rolled, told):
        assert files(directory) == files(upright)
        warnings = json.loads((directory / "summary.json").read_text())["warnings"]
        assert any("reader.mounting=left" in one for one in warnings) == (directory is rolled)
    assert "mounting" not in (upright / "summary.json").read_text()
    # What reads the recording again finds the same axes.
    truth, own = truth_of_run(rolled), truth_of_run(upright)
    np.testing.assert_allclose(truth.T_world_lidar, own.T_world_lidar, atol=1e-6)
    metrics, expected = (json.loads((one / "metrics.json").read_text())["trajectory"] for one in (rolled, upright))
    assert metrics == pytest.approx(expected, abs=1e-6)
    exported, scans = (next(read_run_scans(one).deskewed())[1].points for one in (rolled, upright))
    np.testing.assert_array_equal(exported, scans)


@pytest.mark.long
def test_a_resumed_run_guesses_the_same(recordings, upright, tmp_path):
    words = [word for word in (*FAST, *CONSTANT) if "=" in word]
    config = load_config(settings=[*words, "odometry.method=constant-velocity", "checkpoints.every_scans=3"])
    request = RunRequest(recordings["rolled"], tmp_path / "run", config)

    def progress(done: int, *_: object) -> None:
        if done == 10:
            raise KeyboardInterrupt

    execute(request, progress)
    assert len(read_tum(request.out / "trajectory.tum")) < SCANS
    execute(replace(request, resume=True), lambda *_: None)
    assert files(request.out) == files(upright)


@pytest.mark.long
@pytest.mark.parametrize(("method", "turn"), [
    ("imu", "rolled"), pytest.param("imu", "camera", marks=pytest.mark.slow),
    pytest.param("learned+imu", "rolled", marks=pytest.mark.slow),
])  # fmt: skip
def test_with_the_imu(recordings, tmp_path, method, turn):
    odometry = ["--odometry", method]
    mounting = ["--set", f"reader.mounting={'left' if turn == 'rolled' else 'camera'}"]
    expected = run(recordings["upright"], tmp_path / "upright", *odometry)
    turned = run(recordings[turn], tmp_path / "turned", *odometry, *mounting)
    np.testing.assert_allclose(poses(turned), poses(expected), atol=1e-6)
    np.testing.assert_allclose(load_map(turned).points, load_map(expected).points, atol=1e-5)


@pytest.mark.long
def test_localisation(recordings, upright, tmp_path):
    found = {}
    for name in ("upright again", "rolled again"):
        out = tmp_path / name
        assert "found at scan" in succeeds("localise", recordings[name], "--map", upright, "-o", out, *CONSTANT)
        found[name] = poses(out)
    np.testing.assert_allclose(found["rolled again"], found["upright again"], atol=1e-6)
