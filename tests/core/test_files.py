"""Files are whole or absent, and a directory has one writer."""

import threading
from pathlib import Path

import pytest

from lidarslam.core.errors import OutputError
from lidarslam.core.files import make_directory, only_writer, remove_partial_files, replacing


def names(path: Path) -> list[str]:
    return sorted(entry.name for entry in path.iterdir())


@pytest.mark.parametrize("durable", [False, True])
def test_a_file_takes_its_name_when_it_is_whole(tmp_path: Path, durable: bool) -> None:
    (tmp_path / "file").write_text("earlier")
    with replacing(tmp_path / "file", durable) as partial:
        partial.write_text("new")
        assert (tmp_path / "file").read_text() == "earlier"
    assert (tmp_path / "file").read_text() == "new"
    assert names(tmp_path) == ["file"]


def test_an_error_leaves_the_earlier_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("earlier")
    with pytest.raises(RuntimeError), replacing(tmp_path / "file") as partial:
        partial.write_text("half")
        raise RuntimeError
    assert (tmp_path / "file").read_text() == "earlier"
    assert names(tmp_path) == ["file"]


def test_a_folder_is_not_replaced(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="is a folder"), replacing(tmp_path):
        pass


def test_partial_files_of_a_killed_process_are_removed(tmp_path: Path) -> None:
    (tmp_path / ".partial-1-file").write_text("half")
    (tmp_path / "file").write_text("whole")
    remove_partial_files(tmp_path)
    assert names(tmp_path) == ["file"]


def test_a_directory_is_made_with_its_parents(tmp_path: Path) -> None:
    make_directory(tmp_path / "a" / "b")
    assert names(tmp_path / "a" / "b") == []
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="a file is in the way"):
        make_directory(tmp_path / "file")


def test_a_directory_has_one_writer(tmp_path: Path) -> None:
    with only_writer(tmp_path), pytest.raises(OutputError, match="another lidarslam is writing"), only_writer(tmp_path):
        pass
    with only_writer(tmp_path):
        pass


def test_a_patient_writer_waits_for_the_other(tmp_path: Path) -> None:
    other = only_writer(tmp_path)
    other.__enter__()
    threading.Timer(0.3, other.__exit__, (None, None, None)).start()
    with only_writer(tmp_path, 60.0), pytest.raises(OutputError, match="another lidarslam is writing"):
        only_writer(tmp_path).__enter__()
