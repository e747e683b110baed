"""Files are whole or absent, and nothing foreign is touched."""

from pathlib import Path

import pytest

from lidarslam.core.errors import OutputError
from lidarslam.storage.directory import CONFIG, MAP_PLY, METRICS, RunDirectory


def names(path: Path) -> list[str]:
    return sorted(entry.name for entry in path.iterdir())


@pytest.fixture
def earlier(tmp_path: Path) -> Path:
    """A directory with an earlier run and a file of the user's."""
    with RunDirectory.create(tmp_path / "run") as directory:
        directory.write_text(CONFIG, "run:\n  version: 0\n")
        directory.write_json(METRICS, {"ate": 1.0})
    (tmp_path / "run" / "notes.txt").write_text("mine")
    return tmp_path / "run"


def test_a_new_directory_is_gone_when_nothing_came_of_the_run(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), RunDirectory.create(tmp_path / "run"):
        raise RuntimeError
    assert names(tmp_path) == []


def test_overwriting_replaces_the_earlier_run_and_nothing_else(earlier: Path) -> None:
    with pytest.raises(OutputError, match="--overwrite"), RunDirectory.create(earlier):
        pass
    with pytest.raises(RuntimeError), RunDirectory.create(earlier, overwrite=True):
        raise RuntimeError
    with RunDirectory.create(earlier, overwrite=True) as directory:
        assert names(earlier) == [CONFIG, METRICS, "notes.txt"], "it stays until the new files are there"
        directory.write_text(CONFIG, "run:\n  version: 1\n")
    assert names(earlier) == [CONFIG, "notes.txt"], "no metrics of the run before"
    assert "version: 1" in (earlier / CONFIG).read_text()


def test_files_of_a_runs_names_that_are_no_runs_are_never_touched(tmp_path: Path) -> None:
    (tmp_path / MAP_PLY).write_text("somebody's map")
    (tmp_path / CONFIG).write_text("somebody: config\n")
    for overwrite in (False, True):
        with pytest.raises(OutputError, match="not those of a run"), RunDirectory.create(tmp_path, overwrite):
            pass
    assert (tmp_path / MAP_PLY).read_text() == "somebody's map"


def test_a_directory_with_foreign_files_only_is_used_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with RunDirectory.create(tmp_path) as directory:
        directory.write_text(CONFIG, "run:\n")
    assert (tmp_path / "notes.txt").read_text() == "mine"
