"""What a measurement was made with."""

import subprocess
from pathlib import Path

import pytest

from lidarslam.compare import comparison as described
from lidarslam.compare.comparison import versions


def test_the_programs_that_results_depend_on_are_named() -> None:
    found = versions()
    assert {"lidarslam", "kiss-icp", "numpy", "onnxruntime", "python"} <= set(found)
    assert {"open3d", "open3d-cpu"} & set(found)
    assert all(found.values())


def _git(folder: Path, *arguments: str) -> None:
    names = ("-c", "user.name=n", "-c", "user.email=e@example.org")
    subprocess.run(["git", "-C", str(folder), *names, *arguments], check=True, capture_output=True)


def test_a_checkout_has_a_commit_and_says_that_files_differ(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(described, "__file__", str(tmp_path / "lidarslam" / "run" / "machine.py"))
    assert "commit" not in versions()
    _git(tmp_path, "init")
    (tmp_path / "a").write_text("1")
    _git(tmp_path, "add", "a")
    _git(tmp_path, "commit", "-m", "first", "--no-verify")
    commit = versions()["commit"]
    assert len(commit) == 12
    (tmp_path / "a").write_text("2")
    assert versions()["commit"] == f"{commit}-dirty"
