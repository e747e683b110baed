"""Shared fixtures of the application's tests."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from lidarslam.cli import main
from lidarslam.core.scan import Scan
from lidarslam.core.text.trajectory_io import write_tum
from lidarslam.core.trajectory import Trajectory


@pytest.fixture
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, and nothing is in it."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def small_recording(tmp_path_factory: pytest.TempPathFactory, room_scans: list[Scan], room_truth: Trajectory) -> Path:
    """Six scans with ground truth, not to be written to."""
    folder = tmp_path_factory.mktemp("recordings") / "room"
    folder.mkdir()
    for index, scan in enumerate(room_scans[:6]):
        np.save(folder / f"{index:06d}.npy", scan.points[::3])
    np.savetxt(folder / "timestamps.txt", room_truth.stamps[:6], fmt="%.9f")
    write_tum(folder / "ground_truth.tum", room_truth)
    return folder


@pytest.fixture(scope="session")
def whole_run(tmp_path_factory: pytest.TempPathFactory, small_recording: Path) -> Path:
    """A finished run of it, not to be written to."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    command = ["run", str(small_recording), "--out", str(out), "--odometry", "constant-velocity"]
    assert CliRunner().invoke(main, command).exit_code == 0
    return out


@pytest.fixture
def finished_run(tmp_path: Path, whole_run: Path) -> Path:
    """A copy of a finished run."""
    return Path(shutil.copytree(whole_run, tmp_path / "run"))
