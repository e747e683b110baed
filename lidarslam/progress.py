"""The progress bars."""

import contextlib
import sys
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

from lidarslam.core.tracking import Status
from lidarslam.pipeline import ScanResult
from lidarslam.run import Progress as ProgressCallback

_COLOURS = {Status.OK: "green", Status.DEGRADED: "yellow", Status.LOST: "red"}


class _RateColumn(ProgressColumn):
    """Scans a second."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:5.1f} scans/s")


@contextlib.contextmanager
def show_progress(name: str) -> Iterator[ProgressCallback]:
    """A bar on standard error with scans a second and the state of tracking; nothing where no terminal is attached."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _RateColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[state]}"),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task(name, total=None, state="")
        lost = 0

        def update(number: int, total: int, result: ScanResult) -> None:
            nonlocal lost
            lost += result.status is Status.LOST
            state = f"[{_COLOURS[result.status]}]{result.status.value}[/]" + (f" [red]{lost} lost[/]" if lost else "")
            bar.update(task, completed=number, total=total, state=state)

        yield update


@contextlib.contextmanager
def show_count(name: str) -> Iterator[Callable[[int, int], None]]:
    """A bar on standard error that is told the number of the scan just finished, from 1, and how many there are."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _RateColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task(name, total=None)
        yield lambda number, total: bar.update(task, completed=number, total=total)
