"""Whole recordings: made, read back, replaced or refused, and by the command line."""

import shlex

import numpy as np
import pytest
from scipy.spatial import cKDTree

from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.geometry import transform_points
from lidarslam.core.trajectory import read_tum
from lidarslam.datasets.folders.scan_files import read_ply
from lidarslam.datasets.point_table import coordinates
from lidarslam.datasets.registry import open_recording
from lidarslam.simulation.record import RecordRequest, record
from lidarslam.simulation.world import Boxes, HeightField, Route, World
from lidarslam.simulation.writers import FORMATS

from ..conftest import lidarslam, succeeds

SCANS = 3


@pytest.fixture(autouse=True)
def worlds(monkeypatch):
    """Every world is a hall of 15 x 10 x 4 m with three crates: built in no time."""

    def build(name, seed):
        floor = HeightField(np.array([-8.0, -6.0]), 1.0, np.zeros((17, 13)))
        walls = [(x, 0, 2, 0.2, 5.4, 2) for x in (7.7, -7.7)] + [(0, y, 2, 7.9, 0.2, 2) for y in (5.2, -5.2)]
        walls += [(3, 0.5, 1, 1, 0.6, 1), (-3, -0.2, 0.5, 0.8, 0.6, 0.5), (0, 1, 1.5, 0.5, 0.5, 1.5)]
        table = np.array(walls, dtype=np.float64)
        corners = np.array([[-5.5, -3.2, 0.0], [5.5, -3.2, 0.0], [5.5, 3.2, 0.0], [-5.5, 3.2, 0.0]])
        boxes = Boxes(table[:, :3], table[:, 3:], np.tile(np.eye(3), (len(table), 1, 1)))
        return World(name, seed, Route(corners, 1.0, 1.0, 4.0, 3.0), boxes, height_fields=(floor,))

    monkeypatch.setattr("lidarslam.simulation.recorder.build_world", build)


def request(out, **changes):
    values = {
        "world": "hall", "sensor": "vlp-16", "motion": "tracked", "mount": "tilted", "scans": SCANS, "seed": 4,
        "format": "mcap",
    }  # fmt: skip
    return RecordRequest(out, **{**values, **changes})


@pytest.mark.parametrize("name", ["ply", "mcap"])
def test_a_recording_with_an_imu(name, tmp_path):
    outs = [tmp_path / "with", tmp_path / "without"]
    for out in outs:
        record(request(out, format=name, imu=out.name == "with"), silently)
    imu, scans = open_recording(outs[0]).imu, list(open_recording(outs[0]).scans())
    assert len(imu) == SCANS * 20 + 1
    assert imu.stamps[0] == scans[0].stamp
    assert imu.stamps[-1] == pytest.approx(scans[-1].stamp + 0.1, abs=1e-6)
    assert np.median(np.linalg.norm(imu.accelerations, axis=1)) == pytest.approx(9.81, abs=0.3)  # it starts at rest
    assert open_recording(outs[1]).imu is None
    for scan, same in zip(scans, open_recording(outs[1]).scans(), strict=True):
        np.testing.assert_array_equal(scan.points, same.points)
    readmes = [(out / "README.md").read_text() for out in outs]
    assert ["The IMU" in readme and "--imu" in readme for readme in readmes] == [True, False]
    record(request(outs[0], format=name, overwrite=True), silently)
    assert open_recording(outs[0]).imu is None


def silently(number, total):
    pass


@pytest.mark.parametrize("name", FORMATS)
def test_a_recording_of_every_format_is_true(name, tmp_path):
    out = tmp_path / "recordings" / "a hall"
    told = []
    summary = record(request(out, format=name), lambda *numbers: told.append(numbers))
    assert told == [(1, SCANS), (2, SCANS), (3, SCANS)]
    assert [entry.name for entry in out.parent.iterdir()] == ["a hall"]
    true_map = cKDTree(coordinates(read_ply(out / "map.ply")))
    assert true_map.n == summary.map_points
    truth = read_tum(out / "ground_truth.tum")
    readme = (out / "README.md").read_text()
    assert f"lidarslam simulate --out {shlex.quote(str(out))} --world hall --sensor vlp-16 --motion tracked" in readme
    assert f"--mount tilted --scans {SCANS} --seed 4 --format {name}\n" in readme
    assert f"lidarslam run {shlex.quote(str(summary.source))}" in readme
    assert all(file in readme for file in ("ground_truth.tum", "map.ply"))
    for recording in map(open_recording, {out, summary.source}):
        assert len(recording) == summary.scans == SCANS
        assert recording.describe().ground_truth is not None
        np.testing.assert_allclose(recording.ground_truth.stamps, truth.stamps, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(recording.ground_truth.T_world_lidar, truth.T_world_lidar, atol=2e-8)
        for number, scan in enumerate(recording.scans()):
            assert scan.stamp == pytest.approx(truth.stamps[number], abs=1e-9)
            # It starts at rest, so that the points need no compensation.
            assert (scan.time_offsets is None) == (name == "kitti")
            points = transform_points(truth.T_world_lidar[number], scan.points)
            distances, _ = true_map.query(points)
            assert np.median(distances) < 0.035  # half the distance between samples of the map
            assert np.quantile(distances, 0.99) < 0.12


def test_same_request_same_bytes(tmp_path):
    one, same, other = folders = [tmp_path / name for name in ("one", "same", "other")]
    for folder, seed in zip(folders, (4, 4, 5), strict=True):
        record(request(folder, format="ply", scans=2, seed=seed), silently)
    for path in one.iterdir():
        if path.name != "README.md":  # which names the folder
            assert path.read_bytes() == (same / path.name).read_bytes()
    assert (other / "scan_000000.ply").read_bytes() != (one / "scan_000000.ply").read_bytes()


def test_nothing_is_left_of_a_recording_that_failed(tmp_path):
    def interrupt(number, total):
        (partial,) = tmp_path.iterdir()
        assert partial.name.startswith(".hall.partial-")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record(request(tmp_path / "hall"), interrupt)
    assert not list(tmp_path.iterdir())


def test_an_earlier_recording_is_replaced_only_when_asked_for(tmp_path):
    out = tmp_path / "hall"
    record(request(out, format="ply"), silently)
    before = (out / "scan_000002.ply").read_bytes()
    with pytest.raises(OutputError, match=r"holds a recording already.*--overwrite"):
        record(request(out, format="ply", scans=1), silently)
    assert (out / "scan_000002.ply").read_bytes() == before
    record(request(out, format="mcap", scans=1, overwrite=True), silently)
    assert sorted(path.name for path in out.iterdir()) == [
        "README.md", "ground_truth.tum", "hall.mcap", "map.ply", "metadata.yaml",
    ]  # fmt: skip
    assert [path.name for path in tmp_path.iterdir()] == ["hall"]


def test_other_peoples_files_are_never_replaced(tmp_path):
    out = tmp_path / "photos"
    out.mkdir()
    (out / "cat.png").touch()
    with pytest.raises(OutputError, match=r"holds other files \(cat.png\)"):
        record(request(out, overwrite=True), silently)
    with pytest.raises(OutputError, match="a file is in the way"):
        record(request(out / "cat.png", overwrite=True), silently)
    with pytest.raises(OutputError, match="cannot be written"):
        record(request(out / "cat.png" / "hall"), silently)
    recording = tmp_path / "hall"
    record(request(recording, scans=1), silently)
    (recording / "runs").mkdir()
    with pytest.raises(OutputError, match=r"more than a simulated recording \(runs\)"):
        record(request(recording, scans=1, overwrite=True), silently)
    assert (recording / "runs").is_dir()


@pytest.mark.parametrize("kind", ["format", "sensor", "mount", "motion"])
def test_unknown_names(kind, tmp_path):
    with pytest.raises(InputError, match=f"no .*{kind} is called 'unheard-of'"):
        record(request(tmp_path / "hall", **{kind: "unheard-of"}), silently)
    assert not list(tmp_path.iterdir())


def test_a_speed_is_kept_and_written_down(tmp_path):
    summary = record(request(tmp_path / "a", motion="car", speed_mps=0.4, scans=40, sensor="livox"), silently)
    assert 0.2 < summary.length_m / summary.duration_s < 0.4
    text = (tmp_path / "a" / "README.md").read_text()
    assert "--motion car --speed 0.4 --mount" in text
    assert "car at 0.4 m/s" in text


def test_command(tmp_path):
    out = tmp_path / "hall"
    arguments = ["simulate", "--out", out, "--world", "hall", "--scans", "2"]
    said = succeeds(*arguments)
    assert f"next: lidarslam run {out}" in said
    assert "2 scans of a vlp-16 (upright, handheld) in hall, seed 0" in said
    again = lidarslam(*arguments)
    assert again.exit_code == 1
    assert "holds a recording already" in again.output
    succeeds(*arguments, "--overwrite")
    assert "/velodyne_points" in succeeds("info", out)
