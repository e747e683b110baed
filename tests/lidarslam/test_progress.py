"""The progress bars."""

import io

import pytest

from lidarslam.run.progress import show_count


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_names_with_brackets_are_shown_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with show_count("a[red]b[/nothing]") as count:
        count(1, 2)
    assert "a[red]b[/nothing]" in terminal.getvalue()
