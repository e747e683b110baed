"""Hints that can be typed."""

import sys
from pathlib import Path

import pytest

from lidarslam.core.text import as_typed


@pytest.fixture
def environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The programs of an environment that is not on the path, seen from the folder it lies in."""
    programs = tmp_path / ".venv" / "bin"
    programs.mkdir(parents=True)
    for name in ("python", "lidarslam"):
        (programs / name).write_text("#!/bin/sh\n")
        (programs / name).chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(programs / "python"))
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.chdir(tmp_path)
    return programs


def test_a_program_off_the_path_is_named_by_its_file(environment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert as_typed("lidarslam") == "./.venv/bin/lidarslam"
    monkeypatch.chdir(environment)
    assert as_typed("lidarslam") == "./lidarslam"
    monkeypatch.chdir("/usr")
    assert as_typed("lidarslam") == str(environment / "lidarslam")


def test_a_program_on_the_path_is_named_by_its_name(environment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(environment))
    assert as_typed("lidarslam") == "lidarslam"


def test_another_program_of_the_name_on_the_path_is_not_meant(
    environment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "other"
    other.mkdir()
    (other / "lidarslam").write_text("#!/bin/sh\n")
    (other / "lidarslam").chmod(0o755)
    monkeypatch.setenv("PATH", str(other))
    assert as_typed("lidarslam") == "./.venv/bin/lidarslam"


def test_a_program_that_is_not_beside_keeps_its_name(environment: Path) -> None:
    assert as_typed("rerun") == "rerun"
