"""The progress bars."""

import io

import pytest

from lidarslam.run.progress import show_progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_before_the_first_scan_the_bar_says_what_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with show_progress("a[red]b[/nothing]") as progress:
        progress.phase("compiling loops")
    assert "compiling loops" in terminal.getvalue()
    assert "a[red]b[/nothing]" in terminal.getvalue()
