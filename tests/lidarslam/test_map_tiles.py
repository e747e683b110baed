"""A large map on disk: tiles with an index, an overview, and nothing of an earlier run."""

import json
import shutil
from pathlib import Path

import laspy
import numpy as np
import pytest
from scipy.spatial import cKDTree

from lidarslam.storage.finished_run import load_map
from lidarslam.storage.unfinished import remove_run

from ..conftest import lidarslam, succeeds

FAST = ("--no-report", "--odometry", "constant-velocity", "--set", "global_map.voxel_size_m=0.1")
MOST = 2_000
BOUND = ("--set", f"global_map.most_points={MOST}")


@pytest.fixture(scope="module")
def whole(small_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with its map in one piece."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    succeeds("run", small_recording, "--out", out, *FAST)
    assert not (out / "map").exists()
    assert json.loads((out / "summary.json").read_text())["map_tiles"] is None
    return out


@pytest.mark.parametrize("graph", [(), ("--pose-graph",)])
def test_a_run_with_tiles(whole, small_recording, tmp_path, graph):
    out, expected = tmp_path / "run", whole
    if graph:
        expected = tmp_path / "expected"
        succeeds("run", small_recording, "--out", expected, *FAST, *graph)
    said = succeeds("run", small_recording, "--out", out, *FAST, *BOUND, *graph)
    index, summary = (json.loads((out / name).read_text()) for name in ("map/index.json", "summary.json"))
    assert (index["frame"], index["voxel_size_m"], index["tile_edge_m"]) == ("world", 0.1, 100.0)
    assert {path.name for path in (out / "map").iterdir()} == {"index.json", *(t["file"] for t in index["tiles"])}
    assert [t["file"] for t in index["tiles"]] == ["-1_-1.laz", "-1_0.laz", "0_-1.laz", "0_0.laz"]
    parts = []
    for tile in index["tiles"]:
        points = laspy.read(out / "map" / tile["file"]).xyz
        assert len(points) == tile["points"]
        np.testing.assert_allclose([points.min(axis=0), points.max(axis=0)], [tile["min"], tile["max"]], atol=2e-4)
        np.testing.assert_array_equal(np.floor(points[:, :2].mean(axis=0) / 100.0), tile["tile"])
        parts.append(points)
    found, wanted = np.vstack(parts), load_map(expected).points
    off_m, rows = cKDTree(found).query(wanted)
    assert off_m.max() < 1e-4
    assert len(found) == len(wanted) == len(np.unique(rows)) == index["points"]
    thinned = load_map(out)
    assert len(thinned) == summary["map_points"] <= MOST
    assert summary["map_voxel_size_m"] > 0.1
    assert summary["map_tiles"] == {"tiles": 4, "points": len(found), "voxel_size_m": 0.1}
    assert f"map of {len(found):,} points in 4 tiles, map/, voxels of 10 cm" in said
    assert f"map.ply: {len(thinned):,} points, one per" in said
    assert (out / "trajectory.tum").read_bytes() == (expected / "trajectory.tum").read_bytes()


def test_tiles_of_an_earlier_run_go_with_it(whole, small_recording, tmp_path):
    out = tmp_path / "run"
    succeeds("run", small_recording, "--out", out, *FAST, *BOUND)
    (out / "map" / "7_-3.laz").write_bytes(b"of a run that was killed")
    succeeds("run", small_recording, "--out", out, *FAST, *BOUND, "--overwrite")
    assert not (out / "map" / "7_-3.laz").exists()
    (out / "map" / "mine.laz").write_bytes(b"of someone else")
    succeeds("run", small_recording, "--out", out, *FAST, "--overwrite")
    assert [path.name for path in (out / "map").iterdir()] == ["mine.laz"]
    assert (out / "map.ply").read_bytes() == (whole / "map.ply").read_bytes()
    (out / "map" / "mine.laz").unlink()
    succeeds("run", small_recording, "--out", out, *FAST, *BOUND, "--overwrite")
    remove_run(out)
    assert not out.exists()


def test_tiles_of_others_are_not_touched(small_recording, tmp_path):
    """Neither where they lie in a folder that is no run's, nor a file of their name, nor where a link in one leads."""
    out, elsewhere = tmp_path / "run", tmp_path / "elsewhere"
    for folder in (out / "map", elsewhere):
        folder.mkdir(parents=True)
        for name in ("index.json", "0_0.laz"):
            (folder / name).write_text("precious")
    result = lidarslam("run", small_recording, "--out", out, *FAST, *BOUND)
    assert result.exit_code == 1
    assert "holds files that are not those of a run (map/index.json, map/0_0.laz)" in result.stderr
    shutil.rmtree(out)
    out.mkdir()
    (out / "map").write_text("a file")
    result = lidarslam("run", small_recording, "--out", out, *FAST, *BOUND)
    assert (result.exit_code, f"{out / 'map'}: a file is in the way" in result.stderr) == (1, True)
    assert [path.name for path in out.iterdir()] == ["map"]
    (out / "map").unlink()
    succeeds("run", small_recording, "--out", out, *FAST)
    (out / "map").symlink_to(elsewhere)
    for more in ((), BOUND):
        succeeds("run", small_recording, "--out", out, *FAST, *more, "--overwrite")
    assert (out / "map" / "0_0.laz").stat().st_size > 1000
    assert [path.read_text() for path in elsewhere.iterdir()] == ["precious", "precious"]


def test_a_merge_with_tiles(small_recording, tmp_path):
    """The common map and that of each recording."""
    sources = [shutil.copytree(small_recording, tmp_path / name) for name in ("one", "two")]
    out = tmp_path / "merged"
    result = lidarslam("merge", *sources, "--out", out, *FAST[1:], *BOUND)
    assert result.exit_code in (0, 1), result.output  # 1: nothing joins them
    for folder in (out, out / "01_one", out / "02_two"):
        index, summary = (json.loads((folder / name).read_text()) for name in ("map/index.json", "summary.json"))
        assert sum(tile["points"] for tile in index["tiles"]) == summary["map_tiles"]["points"] > MOST
        assert 0 < summary["map_points"] <= MOST


def test_the_python_interface_writes_tiles(tmp_path, small_recording):
    from lidarslam import Slam

    settings = {"odometry.method": "constant-velocity", "global_map.voxel_size_m": 0.1, "global_map.most_points": MOST}
    with Slam(settings) as slam:
        for index in range(6):
            slam.register_frame(np.load(small_recording / f"{index:06d}.npy"), None, 0.1 * index)
        assert 0 < len(slam.map()) <= MOST
        slam.save(tmp_path / "run")
    index = json.loads((tmp_path / "run" / "map" / "index.json").read_text())
    assert index["points"] > MOST
