"""Runs with loops given and forbidden, with LOAM, and what they say of times, elevations and maps that are wrong."""

import csv
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result
from scipy.spatial.transform import Rotation

from lidarslam.compare.method_run import Ending, Limits, judge
from lidarslam.config.settings import read_yaml
from lidarslam.core.geometry import FloatArray, exp, inverse
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory, chain, read_tum
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.mounting import correct_elevation
from lidarslam.datasets.registry import open_recording
from lidarslam.evaluation.map.entropy import map_entropy, sampled_map_entropy
from lidarslam.run.calibration import prior_warning, time_scale, time_scale_warning

from ..conftest import Drive, lidarslam, succeeds, write_recording
from ..mapping.runs import errors
from .conftest import FAST, refused, summary_of


def command(source: Path, out: Path, *arguments: object) -> list[object]:
    return ["run", source, "--out", out, *FAST, "--set", "pose_graph.keyframes.distance_m=0.1", *arguments]


def loops(out: Path) -> list[dict[str, Any]]:
    return list(summary_of(out)["pose_graph"]["loops"])


def test_a_given_loop_is_closed_and_part_of_the_run(small_recording, tmp_path):
    out, given = tmp_path / "run", ("--loop", 5, 0, "--no-loop", 1, 4)
    assert "not closed" not in succeeds(*command(small_recording, out, *given))
    (loop,) = [one for one in loops(out) if one["found_by"] == "given"]
    assert (loop["first_scan"], loop["accepted"]) == (0, True)
    described = read_yaml(out / "config.yaml")
    assert (described["run"]["loops"], described["run"]["no_loops"]) == ([[0, 5]], [[1, 4]])
    assert described["pose_graph"]["enabled"]
    assert "is finished already" in succeeds(*command(small_recording, out, *given, "--resume"))
    assert "holds another finished run" in refused(*command(small_recording, out, "--loop", 5, 1, "--resume"))


@pytest.mark.parametrize(
    ("overlap", "pair", "reason"),
    [("1.0", (0, 5), "of the points in view are inliers"), ("0.75", (4, 5), "no keyframe lies between the scans")],
)
def test_a_loop_that_cannot_be_closed_is_said_in_a_line(small_recording, tmp_path, overlap, pair, reason):
    distance = () if pair == (0, 5) else ("--set", "pose_graph.keyframes.distance_m=50")
    given = ("--loop", *pair, "--set", f"pose_graph.loops.min_overlap={overlap}", *distance)
    said = succeeds(*command(small_recording, tmp_path / "run", *given))
    (line,) = [line for line in said.splitlines() if "--loop" in line]
    assert line.startswith(f"warning: --loop {pair[0]} {pair[1]} was not closed: ")
    assert reason in line
    assert not any(loop["accepted"] for loop in loops(tmp_path / "run"))


SCANS = 8


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory, room: Any, drive: Drive) -> Path:
    """Sweeps of a scanner with rings."""
    stamps = 0.1 * np.arange(1, SCANS + 1)
    scans, truth = (room.ring_sweep(drive, float(stamp)) for stamp in stamps), Trajectory(stamps, drive(stamps))
    return write_recording(tmp_path_factory.mktemp("recordings") / "room", scans, truth, is_timed=True)


@pytest.mark.long
def test_a_run_with_loam(source, tmp_path):
    out, more = tmp_path / "run", ["--pose-graph", "--set", "pose_graph.keyframes.distance_m=0.2"]
    succeeds("run", source, "--out", out, "--odometry", "constant-velocity", "--mapping", "loam", *more)
    found, truth = (read_tum(path).T_world_lidar for path in (out / "trajectory.tum", source / "ground_truth.tum"))
    assert errors(found, inverse(truth[0]) @ truth)[0].max() < 0.03
    assert "method: loam" in (out / "config.yaml").read_text()
    with (out / "scans.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["ok"] * SCANS
    assert all(0 < int(row["points_used"]) < int(row["points"]) for row in rows[1:])
    assert (out / "map.ply").stat().st_size > 10_000
    assert (out / "pose_graph.g2o").exists()


STAMPS = 100.0 + 0.1 * np.arange(60)


def turning(rates: FloatArray, interval_s: float = 0.1) -> Trajectory:
    """A sensor that turns about z at rates (N,) rad/s."""
    poses = np.tile(np.eye(4), (len(rates), 1, 1))
    angles = np.concatenate([[0.0], np.cumsum(interval_s * rates[:-1])])
    poses[:, :3, :3] = Rotation.from_euler("z", angles[:, None]).as_matrix()
    return Trajectory(100.0 + interval_s * np.arange(len(rates)), poses)


@pytest.mark.parametrize(
    ("ratio", "fault"), [(1.0, None), (0.8, None), (0.5, "too long"), (2.0, "too short"), (-0.6, "backwards")]
)
def test_the_ratio_of_the_turn_rates_is_that_of_the_times(ratio, fault):
    rates = 0.5 * np.sin(STAMPS)
    found = time_scale(turning(rates), ratio * np.outer(rates, [0.0, 0.0, 1.0]), np.full(60, True))
    assert found[0] == pytest.approx(ratio, rel=0.01)
    warning = time_scale_warning(found)
    assert (warning is None) == (fault is None)
    assert warning is None or f"times are {fault}" in warning


def test_few_turns_lost_scans_and_long_intervals_decide_nothing():
    rates, tracked = np.full(60, 0.5), np.full(60, True)
    within = 0.5 * np.outer(rates, [0.0, 0.0, 1.0])
    assert time_scale(turning(rates), within, tracked) is not None
    assert time_scale(turning(0.1 * rates), 0.1 * within, tracked) is None
    assert time_scale(turning(rates), within, ~tracked) is None
    assert time_scale(turning(rates), np.full((60, 3), np.nan), tracked) is None
    assert time_scale(turning(rates, 0.5), within, tracked) is None
    assert time_scale_warning(None) is None


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("time_scale") / "walk"
    succeeds("simulate", "-o", out, "--scans", 40, "--world", "hall", "--motion", "handheld", "--format", "mcap")
    return out


@pytest.mark.long
@pytest.mark.parametrize(("scale", "fault"), [(1.0, None), (2.0, "too long"), (-1.0, "backwards")])
def test_a_run_says_that_the_times_are_wrong(walk, tmp_path, scale, fault):
    options = ["--odometry", "constant-velocity", "--no-report", "--set", f"reader.time_scale={scale}"]
    out = tmp_path / "run"
    lidarslam("run", walk, "--out", out, *options)
    assert summary_of(out)["time_scale"] == pytest.approx(1.0 / scale, rel=0.25)
    warnings = [text for text in summary_of(out)["warnings"] if "points' times" in text]
    assert len(warnings) == (fault is not None)
    assert all(f"times are {fault}" in text for text in warnings)


@pytest.mark.parametrize(("T_lidar_body", "is_warned"), [
    (np.eye(4), False), (exp([0.0, 0.0, 0.0, 0.3, 0.0, 0.2]), False),
    (exp([0.0, 0.0, 0.5 * np.pi, 0.0, 0.0, 0.0]), True),
], ids=["lidar", "displaced", "turned"])  # fmt: skip
def test_a_prior_in_other_axes_is_a_warning(T_lidar_body, is_warned):
    steps = exp(np.tile([0.0, 0.0, 0.02, 0.3, 0.0, 0.0], (40, 1)))
    T_world_lidar = chain(np.eye(4), steps)
    stamps = 0.1 * np.arange(len(T_world_lidar))
    warning = prior_warning(Trajectory(stamps, T_world_lidar @ T_lidar_body), Trajectory(stamps, T_world_lidar))
    assert (warning is not None) == is_warned
    assert warning is None or "on 40 of 40 moving scans" in warning


def documented(heading: str, column: int = 1) -> list[str]:
    """The names in a column of the table below a heading of docs/results.md."""
    text = (Path(__file__).parents[2] / "docs/results.md").read_text().split(f"## {heading}\n")[1].split("\n## ")[0]
    rows = [line.split("|") for line in text.splitlines() if line.startswith("| `")]
    return [name for row in rows for name in re.findall("`([a-z_]+)`", row[column])]


def test_the_files_of_a_run_have_the_documented_keys(whole_run):
    with (whole_run / "scans.csv").open() as file:
        assert next(csv.reader(file)) == documented("scans.csv")
    assert set(summary_of(whole_run)) == set(documented("summary.json"))
    metrics = json.loads((whole_run / "metrics.json").read_text())
    assert list(metrics) == documented("metrics.json")
    assert {*metrics["association"], *metrics["trajectory"]} <= set(documented("metrics.json", 2))


LOW_DEG, STREET_SCANS = 0.4, 36
KEYS = ("elevation_bias_deg", "elevation_sigma_deg", "elevation_correction_deg")


@pytest.fixture(scope="module")
def low(tmp_path_factory: pytest.TempPathFactory, room: Any) -> Path:
    """A folder of scans, in a street, whose points all lie too low."""
    folder = tmp_path_factory.mktemp("elevation") / "street"
    folder.mkdir()
    pillars = tuple((x + side, 5.0 * side, 0.7) for x in range(-56, 56, 6) for side in (-1, 1))
    street = replace(room, half_size=(60.0, 9.0, 3.0), pillars=pillars, points=20_000)
    for number in range(STREET_SCANS):
        T = exp(np.array([0.0, 0.0, 0.0, -20.0 + 1.2 * number, 0.0, -1.0]))
        points = street.sweep(lambda times, T=T: np.tile(T, (len(times), 1, 1)), 0.1 * number).points
        np.save(folder / f"{number:06d}.npy", correct_elevation(points, -LOW_DEG))
    return folder


@pytest.mark.long
def test_a_run_reports_the_bias_and_what_to_set(low, tmp_path):
    succeeds("run", low, "--out", tmp_path / "run", *FAST)
    found = summary_of(tmp_path / "run")
    bias_deg, sigma_deg, correction_deg = (found[key] for key in KEYS)
    assert bias_deg == pytest.approx(LOW_DEG, abs=0.08)
    assert abs(bias_deg - LOW_DEG) < 3.0 * sigma_deg
    assert correction_deg == 0.0
    assert any(f"reader.elevation_correction_deg={bias_deg:.2f}" in warning for warning in found["warnings"])


@pytest.mark.long
def test_corrected_beforehand(low, tmp_path):
    out = tmp_path / "run"
    command = ("run", low, "--out", out, *FAST, "--set", "reader.elevation_correction_deg=auto")
    succeeds(*command)
    found = summary_of(out)
    correction_deg = found["elevation_correction_deg"]
    assert correction_deg == pytest.approx(LOW_DEG, abs=0.08)
    assert found["elevation_bias_deg"] == pytest.approx(LOW_DEG, abs=0.08)
    assert not any("elevation" in warning for warning in found["warnings"])
    # The run says what it used, and is still the one that was asked for.
    assert read_yaml(out / "config.yaml")["reader"]["elevation_correction_deg"] == correction_deg
    succeeds(*command, "--resume")


@pytest.mark.parametrize("mounting", ["upright", "upside-down"])
def test_any_reader_raises_points_above_the_recorded_plane(low, mounting):
    config = ReaderConfig(mounting=mounting, elevation_correction_deg=0.0)
    plain = next(open_recording(low, config).scans()).points
    raised = next(open_recording(low, config.model_copy(update={"elevation_correction_deg": 0.3})).scans()).points
    elevations = [np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])) for p in (plain, raised)]
    expected = 0.3 if mounting == "upright" else -0.3
    np.testing.assert_allclose(np.rad2deg(elevations[1] - elevations[0]), expected, atol=1e-9)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, room_scans: list[Scan]) -> Path:
    """Twenty scans of a room, compensated."""
    return write_recording(tmp_path_factory.mktemp("recordings") / "room", room_scans)


def run(recording: Path, truth: Trajectory, out: Path, scale: float, *more: str) -> tuple[Result, dict[str, Any]]:
    """A run on the true motion, its translation scaled; and the summary."""
    motions = truth.relative_motions()
    motions[:, :3, 3] *= scale
    prior = out.parent / f"{scale}.tum"
    Trajectory(truth.stamps, chain(np.eye(4), motions)).save(prior)
    result = lidarslam("run", recording, "--out", out, "--prior", prior, "--no-mapping", *more)
    return result, summary_of(out)


@pytest.mark.long
def test_a_slide_is_a_warning_and_exit_status_3(tmp_path, recording, room_truth):
    good, fine = run(recording, room_truth, tmp_path / "good", 1.0)
    assert good.exit_code == 0, good.output
    assert fine["map_contradictions"] == []
    assert not any("contradicts itself" in warning for warning in fine["warnings"])
    assert "mean map entropy" in good.output
    slid, summary = run(recording, room_truth, tmp_path / "slid", 0.4)
    assert slid.exit_code == 3, slid.output
    assert summary["lost_scans"] == 0
    assert summary["map_contradictions"][0]["shift_m"] > 0.2
    assert any("contradicts itself" in warning for warning in summary["warnings"])
    assert "the map contradicts itself between scans 0 and" in slid.output
    assert summary["map_entropy"] > fine["map_entropy"]
    ended = judge(Ending("itself", 3, 1.0, None), tmp_path / "slid", tmp_path / "no.log", Limits())
    last = summary["map_contradictions"][0]["last"]
    assert ended == ("lost", f"its map contradicts itself between scans 0 and {last}")
    again, _ = run(recording, room_truth, tmp_path / "slid", 0.4, "--resume")
    assert again.exit_code == 3
    assert "is finished already" in again.output


def test_a_large_map_is_sampled_by_blocks_and_no_map_has_no_entropy(rng):
    ground = rng.uniform(-60.0, 60.0, (400_000, 3)) * [1.0, 1.0, 0.0005]
    part = sampled_map_entropy(ground, 100_000)
    assert 2_000 < part.points <= 10_000
    one, other = sampled_map_entropy(ground), map_entropy(ground, most_samples=10_000)
    assert one == other
    assert part.mean == pytest.approx(one.mean, abs=0.1)
    assert sampled_map_entropy(np.empty((0, 3))) is None
