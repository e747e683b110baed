"""The progress bars."""

import io

import pytest

from lidarslam.run.progress import show_count, show_progress


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


def test_before_the_first_scan_the_bar_says_what_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with show_progress("office") as progress:
        progress.phase("compiling loops")
    assert "compiling loops" in terminal.getvalue()
    assert "0/?" not in terminal.getvalue()
