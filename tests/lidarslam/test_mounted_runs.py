"""Runs over a recording of a sensor on its side come to the results of the upright one."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidarslam.assessment.inputs import truth_of_run
from lidarslam.config.settings import load_config
from lidarslam.core.geometry import make_transform
from lidarslam.core.trajectory import Trajectory, read_tum, write_tum
from lidarslam.exports.source import read_run_scans
from lidarslam.run.request import RunRequest
from lidarslam.run.run import execute
from lidarslam.simulation.motion import mount_pose
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.route_motion import motion_along_route
from lidarslam.simulation.sensors import find_sensor
from lidarslam.simulation.world import build_world

SCANS = 17  # of which the guess looks at every fourth
ROLL = np.round(Rotation.from_euler("x", 90, degrees=True).as_matrix())


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A street as an HDL-32E sees it, upright and rolled by 90 degrees."""
    world = build_world("street", 3)
    motion = motion_along_route("car", world, 3)
    T_body_lidar = mount_pose("upright", motion.sensor_height_m)
    simulation = Simulation(world, find_sensor("hdl-32e"), motion, T_body_lidar, SCANS, 3)
    folders = {"upright": np.eye(3), "rolled": ROLL}
    paths = {name: tmp_path_factory.mktemp(name) for name in folders}
    truth = simulation.ground_truth
    for number, scan in enumerate(simulation.scans()):
        for name, R in folders.items():
            np.save(paths[name] / f"{number:06d}.npy", scan.points @ R.T)
    for name, R in folders.items():
        T = make_transform(R.T, np.zeros(3))
        write_tum(paths[name] / "ground_truth.tum", Trajectory(truth.stamps, truth.T_world_lidar @ T))
    return paths


def begun(source: Path, out: Path, mounting: str = "auto", stop_after: int | None = None, **how: bool) -> Path:
    settings = [f"reader.mounting={mounting}", "odometry.method=constant-velocity", "checkpoints.every_scans=3"]

    def progress(done: int, *_: object) -> None:
        if done == stop_after:
            raise KeyboardInterrupt

    execute(RunRequest(source, out, load_config(settings=settings), **how), progress)
    return out


def files(run: Path) -> dict[str, bytes]:
    return {name: (run / name).read_bytes() for name in ("trajectory.tum", "odometry.tum", "map.ply")}


@pytest.fixture(scope="module")
def upright(recordings, tmp_path_factory) -> Path:
    return begun(recordings["upright"], tmp_path_factory.mktemp("runs") / "upright")


@pytest.mark.parametrize("mounting", ["auto", "left"])
def test_results_are_those_of_the_upright_recording(recordings, upright, tmp_path, mounting):
    run = begun(recordings["rolled"], tmp_path / "run", mounting)
    assert files(run) == files(upright)
    metrics, expected = (json.loads((one / "metrics.json").read_text())["trajectory"] for one in (run, upright))
    assert metrics == pytest.approx(expected, abs=1e-6)
    warned = any("reader.mounting=left" in one for one in json.loads((run / "summary.json").read_text())["warnings"])
    assert warned == (mounting == "auto")
    # What reads the recording again finds the same axes.
    truth, own = truth_of_run(run), truth_of_run(upright)
    np.testing.assert_allclose(truth.T_world_lidar, own.T_world_lidar, atol=1e-6)
    exported, scans = (next(read_run_scans(one).deskewed())[1].points for one in (run, upright))
    np.testing.assert_array_equal(exported, scans)


def test_nothing_is_said_of_an_upright_recording(recordings, upright, tmp_path):
    assert "mounting" not in (upright / "summary.json").read_text()
    assert files(begun(recordings["upright"], tmp_path / "run", "upright")) == files(upright)


def test_a_resumed_run_guesses_the_same(recordings, upright, tmp_path):
    out = tmp_path / "run"
    begun(recordings["rolled"], out, stop_after=10)
    assert len(read_tum(out / "trajectory.tum")) < SCANS
    assert files(begun(recordings["rolled"], out, resume=True)) == files(upright)
