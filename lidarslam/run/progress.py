"""The progress bars."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

from lidarslam.core.text import one_line
from lidarslam.core.tracking import Status

if TYPE_CHECKING:  # slow to load, and not needed by a bar
    from lidarslam.pipeline.estimates import ScanEstimate

# Seconds between lines where there is no terminal for a bar.
_LINE_EVERY_S = 30.0
_COLOURS = {Status.OK: "green", Status.DEGRADED: "yellow", Status.LOST: "red"}


class _RateColumn(ProgressColumn):
    """Scans a second."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:5.1f} scans/s")


def _bar(*more: ProgressColumn) -> Progress:
    """A bar on standard error; silent where no terminal is attached."""
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=20),  # so that all columns fit into a terminal of 80 characters
        MofNCompleteColumn(),
        _RateColumn(),
        TimeRemainingColumn(),
    )
    return Progress(*columns, *more, console=Console(stderr=True), disable=not sys.stderr.isatty())


class RunProgress:
    """A bar with scans a second and the state of tracking; before the first scan, the current step."""

    def __init__(self, bar: Progress, name: str) -> None:
        self._bar = bar
        self._task = bar.add_task(one_line(name), total=None, state="")
        self._lost = 0
        self._name, self._began = one_line(name), time.monotonic()
        self._last_line, self._before = self._began, 0  # scans done before the first one here

    def __call__(self, number: int, total: int, result: "ScanEstimate") -> None:
        """Show that a scan is done, its number from 1, and the total."""
        self._lost += result.status is Status.LOST
        lost = f" [red]{self._lost} lost[/]" if self._lost else ""
        state = f"[{_COLOURS[result.status]}]{result.status.value}[/]{lost}"
        self._bar.update(self._task, completed=number, total=total, state=state)
        self._before = self._before or number
        now = time.monotonic()
        if self._bar.disable and now - self._last_line > _LINE_EVERY_S:
            self._last_line = now
            left_s = (now - self._began) / max(1, number - self._before) * (total - number)
            lost = f", {self._lost:,} lost" if self._lost else ""
            line = f"{self._name}: {number:,} of {total:,} scans{lost}, {left_s / 60.0:.0f} min left"
            print(line, file=sys.stderr, flush=True)

    def phase(self, words: str) -> None:
        self._bar.update(self._task, state=words)


@contextlib.contextmanager
def show_progress(name: str) -> Iterator[RunProgress]:
    """The bar of a run."""
    with _bar(TextColumn("{task.fields[state]}")) as bar:
        yield RunProgress(bar, name)


@contextlib.contextmanager
def show_count(name: str) -> Iterator[Callable[[int, int], None]]:
    """A bar; its callback takes the number of the scan just finished, from 1, and their total."""
    with _bar() as bar:
        task = bar.add_task(one_line(name), total=None)
        yield lambda number, total: bar.update(task, completed=number, total=total)
