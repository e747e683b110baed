"""The files of a run's map: tiles with an index and an overview, fields of its points, further formats."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray, transform_points
from lidarslam.core.trajectory import Trajectory
from lidarslam.storage.directory import remove_run
from lidarslam.storage.finished_run import load_map

from ..conftest import Drive, lidarslam, succeeds

FAST = ("--no-report", "--odometry", "constant-velocity", "--set", "global_map.voxel_size_m=0.1")
MOST = 2_000
BOUND = ("--set", f"global_map.most_points={MOST}")


@pytest.fixture(scope="module")
def whole(small_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
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
    """The common map and that of each recording; all of them can be shown."""
    sources = [shutil.copytree(small_recording, tmp_path / name) for name in ("one", "two")]
    out = tmp_path / "merged"
    result = lidarslam("merge", *sources, "--out", out, *FAST[1:], *BOUND)
    assert result.exit_code in (0, 1), result.output  # 1: nothing joins them
    for folder in (out, out / "01_one", out / "02_two"):
        index, summary = (json.loads((folder / name).read_text()) for name in ("map/index.json", "summary.json"))
        assert sum(tile["points"] for tile in index["tiles"]) == summary["map_tiles"]["points"] > MOST
        assert 0 < summary["map_points"] <= MOST
    succeeds("view", out / "01_one", out / "02_two", "--save", tmp_path / "both.rrd")
    succeeds("view", out, "--picture", tmp_path / "map.png")


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


SCANS = 10
WITHOUT = (0, 3, 4)  # scans that lack the fields
EPOCH = 1_700_000_000.0
XYZ_TIME = [("x", "f8"), ("y", "f8"), ("z", "f8"), ("time", "f8")]
FIELDS = [("intensity", "u2"), ("ring", "u1"), ("rgb", "u4")]
WAYS = {
    "true poses": ["--prior", "{}/ground_truth.tum", "--no-mapping"],
    "registered": ["--odometry", "constant-velocity"],
    "pose graph": ["--odometry", "constant-velocity", "--pose-graph", "--set", "pose_graph.keyframes.distance_m=0.2"],
}
SETTINGS = ["--set", "global_map.voxel_size_m=0.1"]


def brightness(in_room: FloatArray) -> FloatArray:
    """Intensity (N,), 16 bits of it, of points (N, 3) on the surfaces of the room: linear, so that means keep it."""
    return np.asarray(30_000.0 + in_room @ [2_000.0, 1_000.0, 500.0])


def colours(in_room: FloatArray) -> FloatArray:
    """Red, green and blue (N, 3), likewise."""
    return np.asarray(127.0 + in_room @ np.diag([15.0, 20.0, 50.0]))


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory, room: Any, drive: Drive) -> Path:
    """A drive whose intensities and colours follow from where a point lies; the ring is the number of the scan."""
    folder = tmp_path_factory.mktemp("recordings") / "room"
    folder.mkdir()
    stamps = 0.1 * np.arange(1, SCANS + 1)
    for index, stamp in enumerate(stamps):
        scan = replace(room, points=4000).sweep(drive, float(stamp))
        table = np.empty(len(scan), dtype=XYZ_TIME if index in WITHOUT else XYZ_TIME + FIELDS)
        table["x"], table["y"], table["z"], table["time"] = *scan.points.T, scan.time_offsets
        if index not in WITHOUT:
            in_room = transform_points(drive(stamp + scan.time_offsets), scan.points[:, None])[:, 0]
            rgb = np.round(colours(in_room)).astype(np.uint32)
            table["intensity"], table["ring"] = np.round(brightness(in_room)), index
            table["rgb"] = rgb[:, 0] << 16 | rgb[:, 1] << 8 | rgb[:, 2]
        np.save(folder / f"{index:06d}.npy", table)
    np.savetxt(folder / "timestamps.txt", EPOCH + stamps, fmt="%.9f")
    Trajectory(EPOCH + stamps, drive(stamps)).save(folder / "ground_truth.tum")
    return folder


def run(source: Path, out: Path, *arguments: str) -> str:
    return succeeds("run", source, "--out", out, *SETTINGS, *(one.format(source) for one in arguments))


@pytest.mark.long
@pytest.mark.parametrize("way", WAYS)
def test_the_map_has_the_intensities_and_colours_of_its_surfaces(source, tmp_path, drive, way):
    printed = run(source, tmp_path / "run", *WAYS[way])
    assert "voxels of 10 cm, with intensity and rgb;" in printed
    cloud = load_map(tmp_path / "run")
    in_room, known = transform_points(drive(np.array([0.1]))[0], cloud.points), cloud.attributes
    assert known.ring is known.time is None
    has = np.isfinite(known.intensity)
    assert 0.8 < has.mean() < 1.0  # some places were only seen by scans without
    # A voxel's mean point is that of all scans, its intensity that of some.
    off = np.abs(known.intensity - brightness(in_room))[has]
    assert np.median(off) < 2_000.0 * 0.01
    assert off.max() < 2_000.0 * 0.2
    off = np.abs(known.rgb - colours(in_room))[has]
    assert np.median(off) < 1.0
    assert off.max() < 50.0 * 0.2
    assert not known.rgb[~has].any()
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["map_fields"] == ["intensity", "rgb"]
    assert len(dict(known.present())) == 2


@pytest.mark.long
def test_rings_and_times_are_those_of_the_first_point(source, tmp_path, drive):
    run(source, tmp_path / "run", *WAYS["true poses"], "--set", "global_map.fields=[ring, time]")
    known = load_map(tmp_path / "run").attributes
    assert known.intensity is known.rgb is None
    # The number of the scan stands for its ring; its sweep is from 50 ms before to 50 ms after the stamp.
    number = np.round((known.time - EPOCH) / 0.1 - 1.0).astype(int)
    sure = np.abs((known.time - EPOCH) / 0.1 - 1.0 - number) < 0.49
    expected = np.where(np.isin(number, WITHOUT), -1, number)
    np.testing.assert_array_equal(known.ring[sure], expected[sure])
    assert np.bincount(number).argmax() == 0
