"""Methods of a comparison side by side: each pair of recording and method is a task, on this machine or a cluster."""

import contextlib
import tarfile
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path

from lidarslam.compare.methods.process import MethodRun
from lidarslam.compare.methods.run import COMMAND, PROCESS, clear, run_method
from lidarslam.compare.supervised import Limits
from lidarslam.core.tasks import Where, open_tasks
from lidarslam.datasets.fetched import fetch, url_of
from lidarslam.evaluation.comparison.comparison import MethodResult


@dataclass(frozen=True)
class MethodTask:
    """One method on one recording, as a task."""

    run: MethodRun
    limits: Limits
    command: Sequence[str] | None  # the process; None: that of the machine at work
    folder: str  # that relative paths are relative to
    url: str | None  # of the source, where it was fetched
    is_remote: bool  # whether the run directory comes back with the result: the machine may have other disks


@dataclass(frozen=True, eq=False)
class MethodDone:
    """The result of a task."""

    result: MethodResult
    packed: bytes | None  # the run directory of a machine with other disks


def run_side_by_side(
    runs: Sequence[MethodRun],
    limits: Limits,
    command: Sequence[str],
    where: Where,
    on_done: Callable[[int, MethodResult], None],
) -> bool:
    """Run methods to any end; whether Ctrl-C ended that early.

    Args:
        runs: into the directories with the methods' names; earlier runs of a comparison there are replaced.
        limits: of each.
        command: as of `run_method`.
        where: on this machine or a cluster.
        on_done: called with the index of a run and its result, as they end.

    Raises:
        LidarSlamError: the tasks cannot be carried out.
    """
    is_remote, own = where.cluster is not None, None if command == COMMAND else command
    items = [MethodTask(run, limits, own, str(Path.cwd()), url_of(run.request.source), is_remote) for run in runs]

    def take(index: int, done: MethodDone) -> None:
        if done.packed is not None:
            clear(runs[index].request.out)
            with tarfile.open(fileobj=BytesIO(done.packed)) as archive:
                archive.extractall(runs[index].request.out, filter="data")
        on_done(index, done.result)

    try:
        with open_tasks(where) as tasks:
            for _ in tasks.run(run_task, items, take):
                pass
    except KeyboardInterrupt:
        return True
    return False


def run_task(task: MethodTask) -> MethodDone:
    """Run the method of a task; the run directory is packed where it has to be brought back."""
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):  # a machine without that folder has no file there either
            stack.enter_context(contextlib.chdir(task.folder))
        request = task.run.request
        if task.url is not None:
            fetch(task.url, request.source)
        if task.is_remote:
            place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="lidarslam-")))
            # The last two parts stand in the result.
            request = replace(request, out=place / request.out.parent.name / request.out.name)
        run = replace(task.run, request=request)
        result, _ = run_method(run, task.limits, lambda *_: None, task.command or COMMAND)
        return MethodDone(result, _packed(request.out) if task.is_remote else None)


def _packed(folder: Path) -> bytes:
    """The files of a run directory; last the one that says how the process ended, which marks a whole one."""
    packed = BytesIO()
    with tarfile.open(fileobj=packed, mode="w") as archive:
        for path in sorted(folder.iterdir(), key=lambda path: (path.name == PROCESS, path)):
            archive.add(path, path.name)
    return packed.getvalue()
