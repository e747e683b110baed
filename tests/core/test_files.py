"""Files are whole or absent, a directory has one writer, texts are bounded, arrays are read on several threads."""

import threading
from pathlib import Path

import pytest

from lidarslam.core import files as module
from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.files import bounded_lines, only_writer, remove_partial_files, replacing


def names(path: Path) -> list[str]:
    return sorted(entry.name for entry in path.iterdir())


@pytest.mark.parametrize("durable", [False, True])
def test_a_file_takes_its_name_when_it_is_whole(tmp_path, durable):
    (tmp_path / "file").write_text("earlier")
    with replacing(tmp_path / "file", durable) as partial:
        partial.write_text("new")
        assert (tmp_path / "file").read_text() == "earlier"
    assert (tmp_path / "file").read_text() == "new"
    assert names(tmp_path) == ["file"]


def test_an_error_leaves_the_earlier_file(tmp_path):
    (tmp_path / "file").write_text("earlier")
    with pytest.raises(RuntimeError), replacing(tmp_path / "file") as partial:
        partial.write_text("half")
        raise RuntimeError
    assert (tmp_path / "file").read_text() == "earlier"
    assert names(tmp_path) == ["file"]


def test_a_folder_is_not_replaced(tmp_path):
    with pytest.raises(OutputError, match="is a folder"), replacing(tmp_path):
        pass


def test_partial_files_of_a_killed_process_are_removed(tmp_path):
    (tmp_path / ".partial-1-file").write_text("half")
    (tmp_path / "file").write_text("whole")
    remove_partial_files(tmp_path)
    assert names(tmp_path) == ["file"]


def test_a_patient_writer_waits_for_the_other(tmp_path):
    other = only_writer(tmp_path)
    other.__enter__()
    threading.Timer(0.3, other.__exit__, (None, None, None)).start()
    with only_writer(tmp_path, 60.0), pytest.raises(OutputError, match="another lidarslam is writing"):
        only_writer(tmp_path).__enter__()


def test_lines_have_no_ends_and_no_mark(tmp_path):
    (tmp_path / "text").write_bytes(b"\xef\xbb\xbfa \r\n\n\xc3\xa9\xef\xbb\xbf\nlast")
    assert list(bounded_lines(tmp_path / "text")) == ["a ", "", "\u00e9\ufeff", "last"]
    (tmp_path / "empty").touch()
    assert list(bounded_lines(tmp_path / "empty")) == []


@pytest.mark.parametrize("content", [b"1 2\n\xff\xfe", b"1" * 200_000, b"1 2\n" + b" " * 65_537])
def test_what_is_no_text_is_refused(tmp_path, content):
    (tmp_path / "text").write_bytes(content)
    with pytest.raises(InputError, match="text: cannot be read as text"):
        list(bounded_lines(tmp_path / "text"))


def test_a_text_has_a_bounded_length(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_LONGEST_BYTES", 1_000)
    (tmp_path / "long").write_text("1 2 3\n" * 200)
    with pytest.raises(InputError, match="longer than a gigabyte"):
        list(bounded_lines(tmp_path / "long"))
    with pytest.raises(InputError, match="cannot be read as text"):
        list(bounded_lines(tmp_path / "missing"))
