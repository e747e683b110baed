"""Intensity, colour, ring and time of a recording are in the map of a run, where the recording has them."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, transform_points
from lidarslam.core.trajectory import Trajectory, write_tum
from lidarslam.storage.directory import MAPS
from lidarslam.storage.finished_run import load_map, load_run

from ..conftest import succeeds

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
def source(tmp_path_factory: pytest.TempPathFactory, room: Any, drive: Callable[[FloatArray], FloatArray]) -> Path:
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
    write_tum(folder / "ground_truth.tum", Trajectory(EPOCH + stamps, drive(stamps)))
    return folder


def run(source: Path, out: Path, *arguments: str) -> str:
    """Run a recording; what it printed."""
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
    assert len(dict(load_run(tmp_path / "run").map_attributes.present())) == 2


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


@pytest.mark.long
def test_further_formats(source, tmp_path):
    pytest.importorskip("pye57")
    out = tmp_path / "run"
    run(source, out, *WAYS["true poses"], "--pcd", "--map-format", "laz", "--map-format", "e57", "--map-format", "pcd")
    assert {path.name for path in out.iterdir() if path.stem == "map"} == {"map.ply", "map.png", *MAPS.values()}
    run(source, out, *WAYS["true poses"], "--overwrite")
    assert {path.name for path in out.iterdir() if path.stem == "map"} == {"map.ply", "map.png"}
