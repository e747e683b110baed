"""Files are whole or absent, and nothing foreign is touched."""

import json
from pathlib import Path

import pytest

from lidarslam.core.errors import OutputError
from lidarslam.run_directory import CONFIG, METRICS, SUMMARY, RunDirectory


def test_a_new_directory_is_made_with_its_parents_and_is_empty(tmp_path: Path) -> None:
    directory = RunDirectory.create(tmp_path / "lauf für morgen" / "1")
    assert list(directory.path.iterdir()) == []


def test_an_earlier_run_is_not_touched_unless_asked(tmp_path: Path) -> None:
    RunDirectory.create(tmp_path).write_text(CONFIG, "old")
    with pytest.raises(OutputError, match="--overwrite"):
        RunDirectory.create(tmp_path)
    assert (tmp_path / CONFIG).read_text() == "old"


def test_overwriting_removes_the_earlier_run_and_nothing_else(tmp_path: Path) -> None:
    earlier = RunDirectory.create(tmp_path)
    earlier.write_text(CONFIG, "old")
    earlier.write_json(METRICS, {"ate": 1.0})
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "sub").mkdir()
    RunDirectory.create(tmp_path, overwrite=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["notes.txt", "sub"]


def test_a_directory_with_foreign_files_only_is_used_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    RunDirectory.create(tmp_path).write_text(CONFIG, "new")
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_a_file_in_the_way_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="a file is in the way"):
        RunDirectory.create(tmp_path / "file")


def test_a_write_that_fails_leaves_the_old_file_and_no_rest(tmp_path: Path) -> None:
    directory = RunDirectory.create(tmp_path)
    directory.write_text(CONFIG, "old")
    with pytest.raises(RuntimeError), directory.open_text(CONFIG) as out:
        out.write("half")
        raise RuntimeError
    assert [path.name for path in tmp_path.iterdir()] == [CONFIG]
    assert (tmp_path / CONFIG).read_text() == "old"


def test_numbers_that_are_none_are_refused(tmp_path: Path) -> None:
    directory = RunDirectory.create(tmp_path)
    with pytest.raises(ValueError, match="JSON compliant"):
        directory.write_json(SUMMARY, {"x": float("nan")})
    assert list(tmp_path.iterdir()) == []
    directory.write_json(SUMMARY, {"x": None})
    assert json.loads((tmp_path / SUMMARY).read_text()) == {"x": None}
