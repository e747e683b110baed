"""A file that is filled through a pipe, whole or empty."""

import os
from pathlib import Path

import pytest

from lidarslam.rerun_file import PipedFile


def test_what_goes_in_is_in_the_file(tmp_path: Path) -> None:
    content = os.urandom(5_000_000)
    file = PipedFile(tmp_path / "file")
    with file.entrance.open("wb") as entrance:
        file.let_go()
        entrance.write(content)
    assert file.finish()
    assert file.failure is None
    assert (tmp_path / "file").read_bytes() == content


def test_a_write_that_fails_empties_the_file_and_swallows_the_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a disk that fills up does: first it takes a part, then it says so."""
    room = 100_000

    def write(handle: int, piece: bytes) -> int:
        nonlocal room
        if not room:
            raise OSError(28, "No space left on device")
        taken = written(handle, piece[:room])
        room -= taken
        return taken

    written = os.write
    monkeypatch.setattr("lidarslam.rerun_file.os.write", write)
    file = PipedFile(tmp_path / "file")
    with file.entrance.open("wb") as entrance:
        for _ in range(50):
            entrance.write(bytes(100_000))
    assert file.finish()
    assert file.failure is not None
    assert file.failure.errno == 28
    assert (tmp_path / "file").stat().st_size == 0


def test_a_writer_that_never_lets_go_is_not_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lidarslam.rerun_file._LAST_PIECES_S", 0.1)
    file = PipedFile(tmp_path / "file")
    with file.entrance.open("wb"):
        assert not file.finish()
    assert file.finish()
