"""A file that is filled through a pipe, whole or empty."""

import os
import threading
from pathlib import Path

import pytest

from lidarslam.viewer.rerun_recording import _PipedFile as PipedFile


def test_what_goes_in_is_in_the_file(tmp_path: Path) -> None:
    content = os.urandom(5_000_000)
    file = PipedFile(tmp_path / "file")
    with file.entrance.open("wb") as entrance:
        file.close_entrance()
        entrance.write(content)
    assert file.finish()
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
    monkeypatch.setattr("lidarslam.viewer.rerun_recording.os.write", write)
    file = PipedFile(tmp_path / "file")
    with file.entrance.open("wb") as entrance:
        file.close_entrance()
        for _ in range(50):
            entrance.write(bytes(100_000))
    assert file.finish()
    assert (tmp_path / "file").stat().st_size == 0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
def test_a_file_that_cannot_even_be_emptied_holds_no_writer() -> None:
    """As on a disk that fails."""
    file = PipedFile(Path("/dev/full"))

    def write() -> None:
        with file.entrance.open("wb") as entrance:
            opened.set()
            entrance.write(bytes(1_000_000))

    opened = threading.Event()
    writer = threading.Thread(target=write, daemon=True)
    writer.start()
    assert opened.wait(10.0)
    file.close_entrance()
    writer.join(10.0)
    assert not writer.is_alive()
    assert file.finish()


def test_a_writer_that_never_lets_go_is_not_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lidarslam.viewer.rerun_recording._PIPE_S", 0.1)
    file = PipedFile(tmp_path / "file")
    with file.entrance.open("wb"):
        file.close_entrance()
        assert not file.finish()
    monkeypatch.undo()  # what follows is waited for, however busy the machine is
    assert file.finish()
