"""Runs read back: what is damaged is named."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from lidarslam.core.errors import InputError
from lidarslam.core.trajectory import Trajectory
from lidarslam.mapping.global_map.point_cloud import PointCloud
from lidarslam.storage.finished_run import load_map, load_run

from ..conftest import write_run


@pytest.fixture
def finished(tmp_path: Path) -> Path:
    (tmp_path / "scans.csv").write_text("index,status\n0,ok\n1,lost\n2,ok\n")
    still = Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    return write_run(tmp_path, still, PointCloud(np.eye(3), np.eye(3)))


def test_a_run_is_read_back(finished):
    run = load_run(finished)
    np.testing.assert_array_equal(run.lost, [False, True, False])
    np.testing.assert_array_equal(run.map_points, np.eye(3))
    (finished / "map.ply").unlink()
    assert len(load_run(finished).map_points) == 0


@pytest.mark.parametrize(
    ("content", "message"), [(b"index,state\n0,ok\n", "'status' is missing"), (b"index,status\n0,\xff\n", "utf-8")]
)
def test_a_damaged_table_is_named(finished, content, message):
    (finished / "scans.csv").write_bytes(content)
    with pytest.raises(InputError, match=rf"scans\.csv: .*{message}"):
        load_run(finished)


@pytest.mark.parametrize("name", ["map.ply", "map.pcd", "map.txt"])
def test_a_file_that_is_no_cloud(tmp_path, name, capfd):
    with pytest.raises(InputError, match=f"{name}: no such file"):
        load_map(tmp_path / name)
    (tmp_path / name).write_bytes(b"no cloud at all" * 10)
    with pytest.raises(InputError, match=f"{name}: not a readable (point cloud|PLY file|PCD file)"):
        load_map(tmp_path / name)
    assert capfd.readouterr().err == ""


def test_loops_are_those_that_were_closed(finished):
    loops = [
        {"first_scan": 0, "second_scan": 2, "accepted": True},
        {"first_scan": 1, "second_scan": 2, "accepted": False},
        {"first_scan": 1, "second_scan": 3, "accepted": True},  # a run that was interrupted knows no such scan
    ]
    (finished / "summary.json").write_text(json.dumps({"pose_graph": {"loops": loops}}))
    np.testing.assert_array_equal(load_run(finished).loops, [[0, 2]])
    (finished / "summary.json").write_text(json.dumps({"pose_graph": None}))
    assert load_run(finished).loops.shape == (0, 2)
    for damaged in ("{", "[]", "[" * 100_000, '{"scans": 1e999}'):
        (finished / "summary.json").write_text(damaged)
        with pytest.raises(InputError, match="not a run's summary"):
            load_run(finished)


def test_what_is_no_run_is_told(tmp_path, whole_run, small_recording):
    runs = tmp_path / "runs"
    shutil.copytree(whole_run, runs / "one")
    (tmp_path / "notes.txt").write_text("-")
    for path, words in (
        (runs, f"it holds the runs {runs / 'one'}"),
        (runs / "on", f"no such file or folder; did you mean {runs / 'one'}?"),
        (small_recording, "is a recording, not a run directory; make one with lidarslam run"),
        (tmp_path / "notes.txt", "is not a run directory"),
    ):
        with pytest.raises(InputError) as error:
            load_run(path)
        assert words in str(error.value)
