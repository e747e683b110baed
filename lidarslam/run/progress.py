"""The progress bars."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

from lidarslam.core.text import one_line
from lidarslam.core.tracking import Status

if TYPE_CHECKING:  # slow to load, and not needed by a bar
    from lidarslam.pipeline.estimates import ScanEstimate

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

    def __call__(self, number: int, total: int, result: "ScanEstimate") -> None:
        """Show that a scan is done, its number from 1, and the total."""
        self._lost += result.status is Status.LOST
        lost = f" [red]{self._lost} lost[/]" if self._lost else ""
        state = f"[{_COLOURS[result.status]}]{result.status.value}[/]{lost}"
        self._bar.update(self._task, completed=number, total=total, state=state)

    def phase(self, words: str) -> None:
        """Show the current step."""
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
