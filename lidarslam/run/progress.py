"""The progress bars."""

import contextlib
import sys
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

from lidarslam.core.plain_text import one_line
from lidarslam.core.tracking import Status
from lidarslam.pipeline.estimates import ScanResult
from lidarslam.run.tracking import Progress as ProgressCallback

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
        BarColumn(),
        MofNCompleteColumn(),
        _RateColumn(),
        TimeRemainingColumn(),
    )
    return Progress(*columns, *more, console=Console(stderr=True), disable=not sys.stderr.isatty())


@contextlib.contextmanager
def show_progress(name: str) -> Iterator[ProgressCallback]:
    """A bar with scans a second and the state of tracking."""
    with _bar(TextColumn("{task.fields[state]}")) as bar:
        task = bar.add_task(one_line(name), total=None, state="")
        lost = 0

        def update(number: int, total: int, result: ScanResult) -> None:
            nonlocal lost
            lost += result.status is Status.LOST
            state = f"[{_COLOURS[result.status]}]{result.status.value}[/]" + (f" [red]{lost} lost[/]" if lost else "")
            bar.update(task, completed=number, total=total, state=state)

        yield update


@contextlib.contextmanager
def show_count(name: str) -> Iterator[Callable[[int, int], None]]:
    """A bar; its callback takes the number of the scan just finished, from 1, and their total."""
    with _bar() as bar:
        task = bar.add_task(one_line(name), total=None)
        yield lambda number, total: bar.update(task, completed=number, total=total)
