"""The command line as a stranger meets it: help, completion, exit statuses, one-line errors."""

import os
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest
from click.shell_completion import BashComplete

from lidarslam.cli import main
from lidarslam.commands.options import take_config
from lidarslam.commands.runs import run
from lidarslam.config.settings import load_config
from lidarslam.merge.merge import MergedRecording, MergeOutcome
from lidarslam.odometry.config import ImageConfig, NetworkConfig
from lidarslam.odometry.network.checkpoint import checkpoint_of, save_checkpoint
from lidarslam.odometry.network.networks import make_network
from lidarslam.run.summary import WrittenMap

from .conftest import lidarslam, succeeds

OUT = ("--out", "{out}")
RUN, COMPARE, TRAIN = ("run", "{recording}", *OUT), ("compare", *OUT), ("train", *OUT)


def test_every_command_has_a_whole_summary_and_help_with_an_example():
    assert "..." not in lidarslam("--help").output.partition("Commands:")[2]
    for name in main.commands:
        result = lidarslam(name, "--help")
        assert result.exit_code == 0
        assert "Example:" in result.output, name
        assert f"lidarslam {name}" in result.output.split("Example:")[-1], name


def test_weights_are_those_of_the_learned_odometry(recording, tmp_path):
    network = NetworkConfig()
    weights = tmp_path / "weights of mine: 1.safetensors"
    save_checkpoint(weights, checkpoint_of(make_network(network), network, ImageConfig(columns=180)))
    succeeds("run", recording, "--out", tmp_path / "run", "--weights", weights, "--stop", 2, "--no-report")
    learned = load_config(tmp_path / "run" / "config.yaml").odometry
    assert (learned.method, learned.learned.weights) == ("learned", weights)
    for other in (("--odometry", "kiss-icp"), ("--prior", recording / "ground_truth.tum")):
        refused = lidarslam("run", recording, "--out", tmp_path / "other", "--weights", weights, *other)
        assert refused.exit_code == 2
        assert "--weights belongs to --odometry learned" in refused.stderr
        assert not (tmp_path / "other").exists()


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (["info", "no/such/place"], 1, "no such file or folder"),
        (["info", "{recording}", "--set", "reader.name=ros"], 1, "no reader is called 'ros'; there are: evalio, kitti"),
        (["info", ""], 2, "the path is empty"),
        (["view", "{recording}", "--picture", "{out}.png", "--web"], 2, "exclude one another"),
        (["view", "{recording}", "--oblique"], 2, "--oblique belongs to --picture"),
        (["view", "{out}", "--step", "2"], 2, "--step belongs to a recording"),
        (["view", "{out}", "--reader", "rosbag"], 2, "--reader belongs to a recording"),
        (["view", "{out}.rrd", "{out}"], 2, "is shown alone"),
        ([*RUN, "--loop", "2", "2"], 2, "take two scans, not 2 twice"),
        ([*RUN, "--no-loop", "1", "5"], 1, "--no-loop 1 5: the run has 5 scans, from 0"),
        ([*RUN, "--loop", "1", "4", "--no-loop", "4", "1"], 2, "exclude one another"),
        ([*RUN, "--loop", "1", "4", "--no-pose-graph"], 2, "leave --no-pose-graph out"),
        ([*RUN, "--start", "9"], 1, "none of its 5 scans is left"),
        ([*RUN, "--odometry", "constant-velocity", "--no-mapping"], 1, "needs scan-to-map registration"),
        ([*RUN, "--no-mapping", "--mapping", "loam"], 2, "--no-mapping is --mapping off, not --mapping loam"),
        (["run", "{recording}", "--out", "{recording}/000000.npy"], 1, "a file is in the way"),
        ([*RUN, "--prior", "{recording}/ground_truth.tum", "--odometry", "kiss-icp"], 2, "--prior replaces"),
        (["merge", "--out", "{out}"], 2, "missing argument 'SOURCE...' (see lidarslam merge --help)"),
        (["run", "{recording}", "--foo"], 2, "lidarslam: no such option '--foo'"),
        (["merge", "{recording}", "--out", "{out}"], 1, "expected two recordings or more"),
        (["merge", "{recording}", "{recording}/../room", "--out", "{out}"], 1, "is named twice"),
        ([*COMPARE], 2, "name a SOURCE"),
        ([*COMPARE, "{recording}", "--data", "x"], 2, "--data goes with --benchmark"),
        ([*COMPARE, "{recording}", "{recording}", "--prior", "{recording}/timestamps.txt"], 2, "--prior belongs to"),
        ([*COMPARE, "{recording}", "--max", "aet=0.1"], 2, "no figure is called 'aet'; there are: ate, "),
        ([*COMPARE, "{recording}", "--min", "loam:ate=0.1"], 1, "'loam'; there are: learned+map, kiss-icp"),
        ([*COMPARE, "{recording}", "--reuse", "--overwrite"], 1, "choose one"),
        ([*COMPARE, "--benchmark", "indoor"], 2, "the name of a benchmark; there are: ablation, anymal, kitti, "),
        (["config", "-c", "indor"], 2, "neither a file nor the name of a configuration; there are: indoor, "),
        (["config", "-c", ""], 2, "'' is neither a file nor"),
        (["config", "-c", "."], 2, "'.' is neither a file nor"),
        ([*TRAIN], 1, "there is nothing to train on; name a SOURCE"),
        ([*TRAIN, "--set", "training.geometric.robus=1"], 1, "no training.geometric.robus; did you mean robust?"),
        ([*TRAIN, "--resume"], 1, "holds no training to go on with"),
        ([*TRAIN, "--resume", "--overwrite"], 1, "choose one"),
        ([*TRAIN, "--resume", "--from", "shipped"], 1, "leave --from out"),
        ([*TRAIN, "--from", "nowhere.safetensors"], 1, "nowhere.safetensors: no such file"),
    ],
)
def test_mistakes_get_one_line(recording, tmp_path, arguments, status, message):
    places = {"recording": recording, "out": tmp_path / "out"}
    result = lidarslam(*(argument.format(**places) for argument in arguments))
    assert result.exit_code == status
    assert message in result.stderr
    assert "Traceback" not in result.output
    assert result.stderr.count("\n") == 1
    assert result.stdout == ""
    assert not places["out"].exists()


@pytest.mark.parametrize(("arguments", "method"), [
    (["--mapping"], "surfels"), (["--mapping", "loam"], "loam"),
    (["--set", "mapping.method=loam", "--no-mapping"], "off"),
])  # fmt: skip
def test_the_mapping_is_chosen_on_the_command_line(recording, arguments, method):
    context = run.make_context("run", [str(recording), *arguments, "--out", "run"])
    assert take_config(context.params, recording).mapping.method == method


@pytest.mark.parametrize(
    ("joined", "astray", "stopped", "status"),
    [(True, False, (), 0), (True, True, (), 3), (False, True, (), 1), (True, True, ("room: not begun",), 1)],
)
def test_merge_exits_as_run_does_and_says_who_is_left_out(
    recording, tmp_path, monkeypatch, joined, astray, stopped, status
):
    entries = tuple(MergedRecording(f"room{n}", f"0{n}_room", "room", 5, 1.0, 0, joined or n == 1) for n in (1, 2))
    tracked = Mock(metrics=None, summary=Mock(went_astray=astray))
    outcome = MergeOutcome(entries, (tracked, None), stopped, 1.0, None, WrittenMap(10, 0.1, 0), ())
    monkeypatch.setattr("lidarslam.merge.merge.merge", lambda *_: outcome)
    command = ("merge", recording, tmp_path, "--out", tmp_path / "out", "--reader", "scan-folder")
    result = lidarslam(*command)
    assert result.exit_code == status
    left_out = "lidarslam: 02_room: not joined to the others, left out of the common map\n"
    assert (result.stderr == left_out) == (not joined)


@pytest.mark.long
def test_view_writes_a_recording_and_pictures(recording, tmp_path):
    from rerun.chunk import RrdReader

    run = tmp_path / "run"
    succeeds("run", recording, "--out", run)
    succeeds("view", run, run, "--save", tmp_path / "both.rrd")
    entities = {chunk.entity_path for chunk in RrdReader(tmp_path / "both.rrd").stream()}
    first, second = r"/world/run\ \(1\)", r"/world/run\ \(2\)"
    assert {f"{first}/map", f"{first}/trajectory", f"{second}/map", "/world/ground\\ truth"} <= entities
    assert lidarslam("view", recording, "--picture", tmp_path / "none.png").exit_code == 1
    succeeds("view", run, run, "--picture", tmp_path / "both.png")
    assert (tmp_path / "both.png").read_bytes() != (run / "map.png").read_bytes()
    errors = tmp_path / "errors.ply"
    succeeds("evaluate", run, "--reference-map", run / "map.ply", "--errors", errors)
    assert str(tmp_path / "apart" / "errors.ply.png") in succeeds("view", errors, "--picture", tmp_path / "apart")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has a full disk at hand")
def test_a_full_disk_gets_one_line():
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-m", "lidarslam", "config"]
        ended = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert ended.stderr == "lidarslam: No space left on device\n"
    assert ended.returncode == 1


def test_view_shows_the_scans_of_a_recording(recording, tmp_path):
    from rerun.chunk import RrdReader

    succeeds("view", recording, "--save", tmp_path / "scans.rrd", "--start", 1, "--step", 2)
    chunks = list(RrdReader(tmp_path / "scans.rrd").stream())
    scans = [chunk for chunk in chunks if chunk.entity_path == "/world/lidar/scan"]
    assert sum(chunk.num_rows for chunk in scans) == 2
    assert any(chunk.entity_path == r"/world/ground\ truth" for chunk in chunks)
    assert not (recording / "trajectory.tum").exists()


@pytest.mark.long
def test_packages_named_as_our_folders_are_not_in_the_way(tmp_path, recording):
    """A ROS overlay, for example, puts its packages in front of ours."""
    for name in ("odometry", "mapping", "evaluation"):
        (tmp_path / "overlay" / name).mkdir(parents=True)
        (tmp_path / "overlay" / name / "__init__.py").write_text("raise ImportError('the wrong package')")
    command = [sys.executable, "-m", "lidarslam", "run", str(recording), "--out", str(tmp_path / "run"), "--stop", "2"]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "overlay")}
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("before", [True, False])
def test_verbose_says_what_is_chosen_before_the_command_or_after(recording, tmp_path, before, caplog):
    command = ["run", recording, "--out", tmp_path / "run", "--odometry", "constant-velocity", "--no-report"]
    lidarslam(*(["-v", *command] if before else [*command, "-v"]), "--stop", 3)
    said = [record.message for record in caplog.records]
    for words in (
        "reader: scan-folder, because the names fit",
        "time of a point: none is known",
        "3 scans of 5, to ",
        "odometry: constant-velocity; mapping: surfels; pose graph: off",
        "new local map at ",
        "voxels of the map: ",
        "writing the results of 3 scans",
    ):
        assert sum(line.startswith(words) for line in said) == 1, words
    caplog.clear()
    lidarslam(*command, "--stop", 3, "--overwrite")
    assert not caplog.records


@pytest.mark.parametrize(("line", "expected"), [
    ("run --mapping ", ["plain surfels", "plain loam", "plain off"]), ("run -c ind", ["file ind", "plain indoor"]),
    ("compare --benchmark sim", ["file sim", "plain simulated"]), ("run x -o r", ["file r"]),
])  # fmt: skip
def test_words_are_completed(line, expected):
    *words, last = line.split(" ")
    completions = BashComplete(main, {}, "lidarslam", "_LIDARSLAM_COMPLETE").get_completions(words, last)
    assert [f"{item.type} {item.value}" for item in completions] == expected
