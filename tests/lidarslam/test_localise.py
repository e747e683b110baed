"""`lidarslam localise`: a recording of a room found in the map of a run, and one of another room refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lidarslam.core.geometry import inverse
from lidarslam.core.trajectory import read_tum
from lidarslam.storage.finished_run import load_run

from ..conftest import Drive, succeeds, write_recording
from .conftest import FAST, refused, summary_of

SCANS, FIRST = 34, 8
WITHOUT_ODOMETRY = ["--odometry", "constant-velocity"]


def record(folder: Path, room: Any, drive: Drive) -> Path:
    scans = (room.sweep(drive, 0.1 * number) for number in range(1, SCANS + 1))
    return write_recording(folder, scans, is_timed=True)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, uneven_room: Any, drive: Drive) -> Path:
    return record(tmp_path_factory.mktemp("recordings") / "room", uneven_room, drive)


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory, recording: Path) -> Path:
    out = tmp_path_factory.mktemp("runs") / "mapped"
    succeeds("run", recording, "-o", out, *FAST)
    return out


def test_poses_are_in_the_frame_of_the_map(tmp_path, recording, mapped, drive):
    before, out = (mapped / "map.ply").read_bytes(), tmp_path / "again"
    said = succeeds("localise", recording, "--map", mapped, "-o", out, "--start", FIRST, *WITHOUT_ODOMETRY)
    assert "found at scan" in said
    assert (mapped / "map.ply").read_bytes() == before
    trajectory, summary = read_tum(out / "trajectory.tum"), summary_of(out)
    stamps = 0.1 * np.arange(FIRST + 1, SCANS + 1)
    truth = inverse(drive(np.array([0.1]))[0]) @ drive(stamps)
    assert np.linalg.norm((inverse(truth) @ trajectory.T_world_lidar)[:, :3, 3], axis=1).max() < 0.1
    found = summary["localisation"]
    assert found["found"]
    assert Path(found["map"]) == mapped.resolve()
    assert found["placed_afterwards"] == found["found_scan"]
    assert summary["lost_scans"] == 0
    assert {"report.html", "map.png", "scans.csv", "config.yaml"} <= {path.name for path in out.iterdir()}
    run = load_run(out)
    assert run.frame_of == mapped.resolve()
    assert len(run.map_points) == len(load_run(mapped).map_points)


@pytest.mark.long
def test_a_recording_of_another_place_is_refused(tmp_path, room, drive, mapped):
    other = type(room)(half_size=(9.0, 3.0, 1.6), pillars=((5.0, 0.5, 0.5), (-1.0, -1.0, 0.3)))
    elsewhere, out = record(tmp_path / "elsewhere", other, drive), tmp_path / "out"
    assert "not found in" in refused("localise", elsewhere, "--map", mapped, "-o", out, *WITHOUT_ODOMETRY)
    assert not (out / "trajectory.tum").exists()
    found = summary_of(out)["localisation"]
    assert not found["found"]
    assert found["searches_refused"]


def test_what_is_no_map_is_refused_before_anything_is_written(tmp_path, recording, mapped):
    out = tmp_path / "out"
    refused("localise", recording, "--map", recording, "-o", out)
    assert "surfels" in refused("localise", recording, "--map", mapped, "-o", out, "--set", "mapping.method=off")
    assert not out.exists()
