"""The progress bar of a run."""

import contextlib
import sys
from collections.abc import Iterator

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
