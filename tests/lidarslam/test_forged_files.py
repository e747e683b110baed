"""Forged files of a run, of weights, of a benchmark: one line, exit status 1, nothing written elsewhere."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from lidarslam.cli import main
from lidarslam.core.errors import InputError
from lidarslam.datasets.folders.scan_files import read_ply
from lidarslam.odometry.network.exported import DESCRIPTION, read_exported
from lidarslam.odometry.network.shipped import default_weights
from lidarslam.storage.comparison_folder import run_directories
from lidarslam.storage.unfinished import Unfinished

FAST = ("--odometry", "constant-velocity", "--no-report")
DEEP = "[" * 100_000
LONG = "9" * 5_000


def lidarslam(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments], catch_exceptions=False)


def refused(result: Result, *words: str) -> None:
    assert result.exit_code == 1
    said = result.stderr.strip().splitlines()[-1]
    assert said.startswith("lidarslam: ")
    assert not [word for word in words if word not in said], said


RUNS = [
    DEEP,
    f'{{"description": {DEEP}',
    '{"standing": "at work", "description": {}, "resumed_after": [1e999]}',
    f'{{"standing": "at work", "description": {{}}, "resumed_after": [{LONG}]}}',
    '{"standing": "at work", "description": {}, "resumed_after": ["x"]}',
    '{"standing": "at work", "description": {"merge": "all", "sources": 5}, "resumed_after": []}',
    '{"standing": "at work", "description": {"merge": "all", "parts": [5]}, "resumed_after": []}',
    '{"standing": "at work", "description": {"source": {"a": []}}, "resumed_after": []}',
    '{"standing": "at work", "description": {"source": "\\u0000"}, "resumed_after": []}',
    '{"standing": "at work", "description": [], "resumed_after": []}',
    '{"standing": 5, "description": {}, "resumed_after": []}',
    "5",
]


@pytest.mark.parametrize("text", RUNS, ids=range(len(RUNS)))
def test_a_forged_run_json(finished_run: Path, small_recording: Path, text: str) -> None:
    (finished_run / "unfinished").mkdir()
    (finished_run / "unfinished" / "run.json").write_text(text)
    for command in (
        ("run", small_recording, "--out", finished_run, *FAST, "--resume"),
        ("evaluate", finished_run),
        ("view", finished_run, "--save", finished_run / "view.rrd"),
        ("merge", small_recording, finished_run / "nothing", "--out", finished_run),
    ):
        result = lidarslam(*command)
        assert result.exit_code == 1
        assert result.stderr.count("\n") == 1


SUMMARIES = [
    DEEP,
    '{"scans": 1e999}',
    '{"scans": [6]}',
    '{"pose_graph": {"loops": 5}}',
    '{"pose_graph": {"loops": [{"first_scan": 1e30, "second_scan": 0, "accepted": true}]}}',
    '{"localisation": {"map": "\\u0000"}}',
    '{"localisation": {"map": 5}}',
    f'{{"scans": {LONG}}}',
]


@pytest.mark.parametrize("text", SUMMARIES, ids=range(len(SUMMARIES)))
def test_a_forged_summary(finished_run: Path, text: str) -> None:
    (finished_run / "summary.json").write_text(text)
    refused(lidarslam("view", finished_run, "--save", finished_run / "view.rrd"), "summary.json: not a run's summary")


COMPARISONS = [DEEP, '{"methods": {"a": {"run": "../../x"}}}', '{"methods": {"a": {"run": "/etc"}}}', '{"methods": 5}',
               '{"methods": {"a": {"run": "a\\u0000"}}}', '{"sequences": [5]}']  # fmt: skip


@pytest.mark.parametrize("text", COMPARISONS, ids=range(len(COMPARISONS)))
def test_a_forged_comparison(tmp_path: Path, text: str) -> None:
    (tmp_path / "comparison.json").write_text(text)
    with pytest.raises(InputError, match=r"comparison\.json: not a comparison"):
        run_directories(tmp_path)


@pytest.mark.parametrize("text", [f'{{"kind": "x", "version": {LONG}}}', DEEP, "[]", '{"version": 1e999}'])
def test_a_forged_network(tmp_path: Path, text: str) -> None:
    (tmp_path / DESCRIPTION).write_text(text)
    with pytest.raises(InputError, match=f"{DESCRIPTION} is missing or damaged"):
        read_exported(tmp_path)


@pytest.mark.parametrize("version", [LONG, "9" * 4_000, "-1", "x", "1" * 20])
def test_weights_of_a_forged_version(tmp_path: Path, small_recording: Path, version: str) -> None:
    header_and_tensors = default_weights().with_suffix(".safetensors").read_bytes()
    length = int.from_bytes(header_and_tensors[:8], "little")
    header = json.loads(header_and_tensors[8 : 8 + length])
    header["__metadata__"]["version"] = version
    text = json.dumps(header).encode()
    forged = tmp_path / "forged.safetensors"
    forged.write_bytes(len(text).to_bytes(8, "little") + text + header_and_tensors[8 + length :])
    result = lidarslam("run", small_recording, "--out", tmp_path / "run", "--no-report", "--weights", forged)
    refused(result, "forged.safetensors: ", "version")
    assert not (tmp_path / "run").exists()
    assert len(result.stderr) < 1_000


@pytest.mark.parametrize("count", ["99999999999999999999", "9223372036854775807", "1000000000000", LONG])
@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_a_ply_with_endless_faces_before_its_vertices(tmp_path: Path, count: str, encoding: str) -> None:
    path = tmp_path / "scan.ply"
    elements = f"element face {count}\nproperty int a\nelement vertex 1\nproperty float x\n"
    path.write_text(f"ply\nformat {encoding} 1.0\n{elements}end_header\n1\n2\n3.0\n")
    with pytest.raises(InputError, match="not a readable PLY file"):
        read_ply(path)


NAMES = ["/abs/path", "../../x", "a/b", "..", "", "a\\0b", "\\e[2J", "report.html", "x" * 121]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("of", ["method", "simulated", "recording"])
def test_a_name_in_a_benchmark_stays_in_the_folder(
    tmp_path: Path, small_recording: Path, name: str, of: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    quoted = f'"{name.replace("/abs", str(tmp_path / "abs"))}"'
    methods = f"[{{name: {quoted}, method: kiss-icp}}]" if of == "method" else "[kiss-icp]"
    source = "simulate: {scans: 2}" if of == "simulated" else f"source: {os.fspath(small_recording)}"
    recordings = f"[{{name: {'a' if of == 'method' else quoted}, {source}}}]"
    (tmp_path / "forged.yaml").write_text(f"title: t\nmethods: {methods}\nrecordings: {recordings}\n")
    refused(lidarslam("compare", "--benchmark", "forged.yaml", "--out", "deep/er/out"))
    assert {path.name for path in tmp_path.iterdir()} == {"forged.yaml"}


def test_a_tampered_rerun_recording(tmp_path: Path, finished_run: Path) -> None:
    rerun_output = pytest.importorskip("lidarslam.viewer.rerun_output")
    file = finished_run / "recording.rrd"
    assert lidarslam("view", finished_run, "--save", file).exit_code == 0
    whole = file.read_bytes()
    forged = {b"": "not a Rerun recording", whole[:-1]: "is cut off", whole[: len(whole) // 2]: "is cut off",
              whole + b"more": "is cut off", b"RRF1" + whole[4:]: "not a Rerun recording"}  # fmt: skip
    for content, message in forged.items():
        file.write_bytes(content)
        with pytest.raises(InputError, match=message):
            rerun_output.show_file_in_window(file)
        refused(lidarslam("view", file), message)
    with pytest.raises(InputError, match="no such file"):
        rerun_output.show_file_in_window(tmp_path)
    assert lidarslam("view", finished_run, "--save", tmp_path / "view.rrd").exit_code == 0


def flipped(content: bytes) -> bytes:
    """Some bits in the middle, which only Rerun could find."""
    return bytes(byte ^ (64 < at < len(content) - 64 and at % 997 == 0) for at, byte in enumerate(content))


@pytest.mark.parametrize("forge", [lambda content: content[:99], flipped, lambda _: b"ply\n", None],
                         ids=["cut", "flipped", "another file", "a folder"])  # fmt: skip
def test_nothing_but_view_reads_the_rerun_recording_of_a_run(
    tmp_path: Path, finished_run: Path, small_recording: Path, forge: Callable[[bytes], bytes] | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    killed = tmp_path / "killed"
    with monkeypatch.context() as patch:
        patch.setattr(Unfinished, "end", lambda *_, **__: None)
        lidarslam("run", small_recording, "--out", killed, *FAST, "--set", "checkpoints.every_scans=2")
    lidarslam("view", finished_run, "--save", tmp_path / "recording.rrd")
    for run in (finished_run, killed):
        if forge is None:
            (run / "recording.rrd").mkdir()
        else:
            (run / "recording.rrd").write_bytes(forge((tmp_path / "recording.rrd").read_bytes()))
    for words in (
        ("evaluate", finished_run),
        ("view", finished_run, "--picture", tmp_path / "view.png"),
        ("run", small_recording, "--out", killed, *FAST, "--resume"),
        ("run", small_recording, "--out", finished_run, *FAST, "--overwrite"),
    ):
        result = lidarslam(*words)
        assert (result.exit_code, result.stderr) == (0, "")
    for run in (finished_run, killed):
        assert (run / "recording.rrd").exists() == (forge is None)  # of no run, and left where it is


def test_two_methods_of_one_name(tmp_path: Path) -> None:
    (tmp_path / "forged.yaml").write_text(
        "title: t\nmethods: [kiss-icp, kiss-icp]\nrecordings: [{name: a, source: a}]\n"
    )
    refused(lidarslam("compare", "--benchmark", tmp_path / "forged.yaml"), "two methods have the same name")
