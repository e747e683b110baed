"""Forged files, links and names: one line, and nothing is written but where it was asked for; nobody is called."""

import os
import socket

import numpy as np
import pytest

from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.files import open_own
from lidarslam.datasets.folders.scan_files import read_ply

from ..conftest import succeeds
from .conftest import refused

LONG = "9" * 5_000


@pytest.mark.parametrize("count", ["99999999999999999999", "9223372036854775807", "1000000000000", LONG])
@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_a_ply_with_endless_faces_before_its_vertices(tmp_path, count, encoding):
    path = tmp_path / "scan.ply"
    elements = f"element face {count}\nproperty int a\nelement vertex 1\nproperty float x\n"
    path.write_text(f"ply\nformat {encoding} 1.0\n{elements}end_header\n1\n2\n3.0\n")
    with pytest.raises(InputError, match="not a readable PLY file"):
        read_ply(path)


NAMES = ["/abs/path", "../../x", "a/b", "..", "", "a\\0b", "\\e[2J", "report.html", "x" * 121]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("of", ["method", "simulated", "recording"])
def test_a_name_in_a_benchmark_stays_in_the_folder(tmp_path, small_recording, name, of, monkeypatch):
    monkeypatch.chdir(tmp_path)
    quoted = f'"{name.replace("/abs", str(tmp_path / "abs"))}"'
    methods = f"[{{name: {quoted}, method: kiss-icp}}]" if of == "method" else "[kiss-icp]"
    source = "simulate: {scans: 2}" if of == "simulated" else f"source: {os.fspath(small_recording)}"
    recordings = f"[{{name: {'a' if of == 'method' else quoted}, {source}}}]"
    (tmp_path / "forged.yaml").write_text(f"title: t\nmethods: {methods}\nrecordings: {recordings}\n")
    refused("compare", "--benchmark", "forged.yaml", "--out", "deep/er/out")
    assert {path.name for path in tmp_path.iterdir()} == {"forged.yaml"}


def test_a_tampered_rerun_recording(tmp_path, finished_run):
    file = finished_run / "recording.rrd"
    succeeds("view", finished_run, "--save", file)
    whole = file.read_bytes()
    forged = {b"": "not a Rerun recording", b"RRF1" + whole[4:]: "not a Rerun recording"}
    forged |= dict.fromkeys((whole[:-1], whole[: len(whole) // 2], whole + b"more"), "is cut off")
    for content, message in forged.items():
        file.write_bytes(content)
        assert message in refused("view", file)
    succeeds("view", finished_run, "--save", tmp_path / "view.rrd")


def test_a_file_is_opened_without_following_links(tmp_path):
    (tmp_path / "outside").write_text("precious")
    (tmp_path / "link").symlink_to(tmp_path / "outside")
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    os.link(tmp_path / "outside", tmp_path / "second")
    os.mkfifo(tmp_path / "pipe")
    for name in ("link", "dangling", "second", "pipe"):
        with pytest.raises(OutputError, match=f"{name}: is a link"):
            open_own(tmp_path / name)
        with open_own(tmp_path / name, anew=True) as file:
            file.write(b"ours")
    assert (tmp_path / "outside").read_text() == "precious"
    assert not (tmp_path / "nowhere").exists()


@pytest.mark.parametrize(
    ("link", "source", "method", "option"),
    [
        ("recordings", "simulate: {scans: 2}", "kiss-icp", "--overwrite"),
        ("recordings/walk", "simulate: {scans: 2}", "kiss-icp", "--overwrite"),
        ("walk", "source: recorded", "kiss-slam", "--reuse"),  # not installed
        ("walk", "source: recorded", "constant-velocity+map", "--overwrite"),
        ("walk/constant-velocity+map", "source: recorded", "constant-velocity+map", "--reuse"),
    ],
)
def test_a_comparison_writes_nothing_behind_a_link(tmp_path, small_recording, link, source, method, option):
    place, outside, benchmark = tmp_path / "out" / link, tmp_path / "outside", tmp_path / "benchmark.yaml"
    place.parent.mkdir(parents=True)
    outside.mkdir()
    place.symlink_to(outside)
    recordings = f"[{{name: walk, {source.replace('recorded', str(small_recording))}}}]"
    benchmark.write_text(f"title: t\nmethods: [{method}]\nrecordings: {recordings}\n")
    said = refused("compare", "--benchmark", benchmark, "--out", tmp_path / "out", option)
    assert f"{place}: is a link to another place" in said
    assert not any(outside.iterdir())


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("somebody asked the network")

    for name in ("connect", "connect_ex", "sendto", "bind"):
        monkeypatch.setattr(socket.socket, name, refuse)
    for name in ("getaddrinfo", "gethostbyname", "create_connection"):
        monkeypatch.setattr(socket, name, refuse)


@pytest.mark.slow  # every kind of command
@pytest.mark.usefixtures("no_network")
def test_only_the_run_directory_is_written_and_nobody_is_called(tmp_path, small_recording, monkeypatch):
    for name, variable in (("home", "HOME"), ("tmp", "TMPDIR")):
        (tmp_path / name).mkdir()
        monkeypatch.setenv(variable, str(tmp_path / name))
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    before = {path: path.stat().st_mtime_ns for path in small_recording.iterdir()}
    command = ("run", small_recording, "--pose-graph", "--rerun", "save", "--pcd", "--odometry", "constant-velocity")
    succeeds(*command, "--out", tmp_path / "run")
    succeeds("evaluate", tmp_path / "run")
    succeeds("view", tmp_path / "run", "--picture", tmp_path / "run" / "map.png")
    succeeds("compare", small_recording, "--methods", "constant-velocity+map", "--out", tmp_path / "compared")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["compared", "here", "home", "run", "tmp"]
    assert [path for name in ("here", "home", "tmp") for path in (tmp_path / name).rglob("*")] == []
    assert {path: path.stat().st_mtime_ns for path in small_recording.iterdir()} == before


def test_rerun_is_told_not_to_report(monkeypatch):
    monkeypatch.delenv("CI", raising=False)
    monkeypatch.setenv("FORCE_RERUN_ANALYTICS", "1")
    succeeds("config")
    assert os.environ.get("CI")
    assert "FORCE_RERUN_ANALYTICS" not in os.environ


def test_names_in_a_recording_do_not_steer_the_terminal(tmp_path, small_recording):
    source = tmp_path / "e\x1b]0;owned\x07\u202e\nnote  all is well"
    source.mkdir()
    np.save(source / "000000.npy", np.load(small_recording / "000000.npy"))
    said = succeeds("info", source)
    assert "\x1b" not in said
    assert "\\x1b]0;owned\\x07\\u202e\\nnote" in said
    assert not [line for line in said.splitlines() if line.startswith("note  all is well")]
