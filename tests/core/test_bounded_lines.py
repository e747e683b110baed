"""Texts of unknown origin, line by line."""

import os
from pathlib import Path

import pytest

from lidarslam.core import files as module
from lidarslam.core.errors import InputError
from lidarslam.core.files import bounded_lines


def test_lines_have_no_ends_and_no_mark(tmp_path: Path) -> None:
    (tmp_path / "text").write_bytes(b"\xef\xbb\xbfa \r\n\n\xc3\xa9\xef\xbb\xbf\nlast")
    assert list(bounded_lines(tmp_path / "text")) == ["a ", "", "\u00e9\ufeff", "last"]
    (tmp_path / "empty").touch()
    assert list(bounded_lines(tmp_path / "empty")) == []


@pytest.mark.parametrize("content", [b"1 2\n\xff\xfe", b"1" * 200_000, b"1 2\n" + b" " * 65_537])
def test_what_is_no_text_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "text").write_bytes(content)
    with pytest.raises(InputError, match="text: cannot be read as text"):
        list(bounded_lines(tmp_path / "text"))


def test_a_file_of_nothing_is_refused_at_once(tmp_path: Path) -> None:
    """Twenty gigabytes that take no room on the disk."""
    (tmp_path / "sparse").touch()
    os.truncate(tmp_path / "sparse", 20 << 30)
    with pytest.raises(InputError, match="a line has more than 65,536 bytes"):
        list(bounded_lines(tmp_path / "sparse"))


def test_a_text_has_a_bounded_length(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_LONGEST_BYTES", 1_000)
    (tmp_path / "long").write_text("1 2 3\n" * 200)
    with pytest.raises(InputError, match="longer than a gigabyte"):
        list(bounded_lines(tmp_path / "long"))
    with pytest.raises(InputError, match="cannot be read as text"):
        list(bounded_lines(tmp_path / "missing"))
