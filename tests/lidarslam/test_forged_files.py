"""Forged files of a run, of weights, of a benchmark: one line, exit status 1, nothing written elsewhere."""

import os
from pathlib import Path

import pytest

from lidarslam.core.errors import InputError
from lidarslam.datasets.folders.scan_files import read_ply
from lidarslam.storage.finished_run import run_directories

from ..conftest import succeeds
from .conftest import refused

DEEP = "[" * 100_000
LONG = "9" * 5_000


SUMMARIES = [
    DEEP,
    '{"scans": 1e999}',
]


@pytest.mark.parametrize("text", SUMMARIES, ids=range(len(SUMMARIES)))
def test_a_forged_summary(finished_run: Path, text: str) -> None:
    (finished_run / "summary.json").write_text(text)
    said = refused("view", finished_run, "--save", finished_run / "view.rrd")
    assert "summary.json: not a run's summary" in said


COMPARISONS = ['{"methods": {"a": {"run": "../../x"}}}', '{"methods": {"a": {"run": "/etc"}}}', '{"sequences": [5]}']


@pytest.mark.parametrize("text", COMPARISONS, ids=range(len(COMPARISONS)))
def test_a_forged_comparison(tmp_path: Path, text: str) -> None:
    (tmp_path / "comparison.json").write_text(text)
    with pytest.raises(InputError, match=r"comparison\.json: not a comparison"):
        run_directories(tmp_path)


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
    refused("compare", "--benchmark", "forged.yaml", "--out", "deep/er/out")
    assert {path.name for path in tmp_path.iterdir()} == {"forged.yaml"}


def test_a_tampered_rerun_recording(tmp_path: Path, finished_run: Path) -> None:
    file = finished_run / "recording.rrd"
    succeeds("view", finished_run, "--save", file)
    whole = file.read_bytes()
    forged = {b"": "not a Rerun recording", b"RRF1" + whole[4:]: "not a Rerun recording"}
    forged |= dict.fromkeys((whole[:-1], whole[: len(whole) // 2], whole + b"more"), "is cut off")
    for content, message in forged.items():
        file.write_bytes(content)
        assert message in refused("view", file)
    succeeds("view", finished_run, "--save", tmp_path / "view.rrd")
