"""Independent tasks, one after another or side by side by Ray, and child processes that end with this one.

Ray is loaded where it is used, and only here.
"""

import contextlib
import logging
import os
import signal
import socket
import subprocess
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, TypeVar

from lidarslam.core.errors import ConfigError, InputError, LidarSlamError, OutputError
from lidarslam.core.plugins import require_library
from lidarslam.core.text import reason

T = TypeVar("T")
R = TypeVar("R")
# Of a task whose process or machine died.
_RETRIES = 3
# Results are small; larger ones are written to disk.
_OBJECT_STORE_BYTES = 128 * 2**20
_ANSWER_S = 5.0
THREADS = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

OnDone = Callable[[int, Any], None]
"""Called with the index of a task and its result, in the order in which tasks end."""


@dataclass(frozen=True)
class Where:
    """Where tasks are carried out."""

    jobs: int = 1  # processes on this machine; 1: this process, one task after another
    cluster: str | None = None  # address of a Ray cluster, whose CPUs are used instead

    @property
    def is_serial(self) -> bool:
        """Whether tasks are carried out in this process."""
        return self.jobs == 1 and self.cluster is None


SERIAL = Where()


class Tasks:
    """Carries out independent tasks, one after another in this process.

    Attributes:
        slots: number of tasks that are carried out at the same time.
    """

    slots = 1

    def run(
        self,
        function: Callable[[T], R],
        items: Sequence[T],
        on_done: OnDone | None = None,
        ahead: int | None = None,  # noqa: ARG002
    ) -> Iterator[R]:
        """The results of `function(item)` in the order of the items; each task begins when its result is asked for.

        Args:
            function, items: of a module that can be imported, and to be pickled; the same item always has the same
                result, as a task whose process or machine died is carried out again.
            on_done: called for each task; after Ctrl-C too, for tasks that still have a result.
            ahead: number of tasks begun before the result of the first of them is taken; None: all.

        Raises:
            KeyboardInterrupt: Ctrl-C; no task is running any more.
            LidarSlamError: a task raised it, or its process died repeatedly.
        """
        for index, item in enumerate(items):
            result = function(item)
            if on_done is not None:
                on_done(index, result)
            yield result


def open_tasks(where: Where) -> contextlib.AbstractContextManager[Tasks]:
    """The executor of the tasks, for the duration of the context; ConfigError where Ray or the cluster is not there."""
    if where.is_serial:
        return contextlib.nullcontext(Tasks())
    require_library("ray", "--jobs and --ray need", "pip install 'lidarslam[ray]'")
    return _ray_tasks(where)


@contextlib.contextmanager
def _ray_tasks(where: Where) -> Iterator[Tasks]:
    """A Ray of our own on this machine, which ends with the context, or the connection to a cluster."""
    import ray

    logging.getLogger("ray").setLevel(logging.CRITICAL)
    with contextlib.ExitStack() as stack:
        stack.enter_context(_environment(where))
        place = stack.enter_context(tempfile.TemporaryDirectory(prefix="lidarslam-", ignore_cleanup_errors=True))
        stack.callback(ray.shutdown)
        options: dict[str, Any] = {"address": where.cluster or "local", "log_to_driver": False}
        if where.cluster is None:
            options |= {"num_cpus": where.jobs, "object_store_memory": _OBJECT_STORE_BYTES, "_temp_dir": place}
            options["include_dashboard"] = False
        try:
            with _own_signals():
                _require_answer(where.cluster or "")
                ray.init(logging_level=logging.CRITICAL, **options)
        except Exception as error:  # Ray raises plain ones, too
            if where.cluster is None:
                raise ConfigError(f"--jobs {where.jobs}: Ray does not start: {reason(error)}") from error
            nowhere = "no cluster answers there; this machine has to be one of its nodes"
            raise ConfigError(f"--ray {where.cluster}: {nowhere} ({reason(error)})") from error
        slots = int(ray.cluster_resources().get("CPU", 0))
        if not slots:
            raise ConfigError(f"--ray {where.cluster}: the cluster has no CPU; start nodes with ray start")
        yield _RayTasks(slots)


class _RayTasks(Tasks):
    """Side by side, by one connection to Ray."""

    def __init__(self, slots: int) -> None:
        self.slots = slots

    def run(
        self, function: Callable[[T], R], items: Sequence[T], on_done: OnDone | None = None, ahead: int | None = None
    ) -> Iterator[R]:
        import ray

        remote: Any = ray.remote(num_cpus=1, max_retries=_RETRIES)(_carry_out)
        shared = ray.put((function, version("lidarslam")))
        running: dict[Any, int] = {}
        results: dict[int, Any] = {}
        begun = taken = 0
        try:
            while taken < len(items):
                while begun < len(items) and (ahead is None or begun < taken + ahead):
                    running[remote.remote(shared, items[begun])] = begun
                    begun += 1
                if taken in results:
                    yield results.pop(taken)
                    taken += 1
                    continue
                _take(ray.wait([*running], num_returns=1)[0], running, results, on_done)
        except BaseException:
            _end(running, results, on_done)
            raise


def _take(done: list[Any], running: dict[Any, int], results: dict[int, Any], on_done: OnDone | None) -> None:
    import ray

    for reference in done:
        index = running.pop(reference)
        try:
            result = ray.get(reference)
        except ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, ImportError):
                raise ConfigError(f"a node of the cluster lacks a library: {error.cause}") from None
            raise (error.cause if isinstance(error.cause, Exception) else RuntimeError(str(error))) from None
        except ray.exceptions.RayError as error:
            failed = f"a task came to no result in {_RETRIES + 1} attempts"
            raise LidarSlamError(f"{failed} ({type(error).__name__}); see Ray's log") from error
        if isinstance(result, LidarSlamError):
            raise result
        results[index] = result
        if on_done is not None:
            on_done(index, result)


def _end(running: dict[Any, int], results: dict[int, Any], on_done: OnDone | None) -> None:
    """Interrupt all tasks as Ctrl-C would, and wait until they have ended; a second Ctrl-C ends that."""
    import ray

    for reference in running:
        ray.cancel(reference, force=False)
    while running:
        done = ray.wait([*running], num_returns=1)[0]
        with contextlib.suppress(Exception):  # cancelled, or as it was interrupted
            _take(done, running, results, on_done)


def _carry_out(shared: tuple[Callable[[T], R], str], item: T) -> R | LidarSlamError:
    """One task, in a process of Ray; an error that the user can correct is its result.

    Ray would try to pickle the error itself, with the arguments of its class.
    """
    function, expected = shared
    if version("lidarslam") != expected:
        return ConfigError(f"a node of the cluster has lidarslam {version('lidarslam')} and not {expected}; update it")
    for name in THREADS:
        os.environ.setdefault(name, os.environ.get("OMP_NUM_THREADS", "1"))
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # inherited of nohup; Ray interrupts a task by this signal
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return function(item)
    except LidarSlamError as error:
        kinds = (InputError, ConfigError, OutputError, LidarSlamError)
        return next(kind for kind in kinds if isinstance(error, kind))(str(error))


@contextlib.contextmanager
def _environment(where: Where) -> Iterator[None]:
    """The environment that Ray's processes inherit: no report to its makers, our own limits of memory, and threads.

    Each task on this machine has its share of the cores; on a cluster Ray gives it one.
    """
    wanted = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_memory_monitor_refresh_ms": "0"}
    if where.cluster is None:
        wanted |= dict.fromkeys(THREADS, str(max(1, usable_cores() // where.jobs)))
    added = {name: value for name, value in wanted.items() if name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)


def usable_cores() -> int:
    """The number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1  # not on macOS


@contextlib.contextmanager
def _own_signals() -> Iterator[None]:
    """Ray's handler of SIGTERM, which would end the program, is taken out again."""
    handler = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, handler)


def _require_answer(address: str) -> None:
    """Raise OSError where nothing listens at HOST:PORT; Ray would try for minutes."""
    host, colon, port = address.rpartition(":")
    if colon and port.isdecimal() and "/" not in host:
        socket.create_connection((host.strip("[]"), int(port)), _ANSWER_S).close()


# A shell waits for the end of its standard input, which the system closes with this process, and kills a group.
_WATCH = 'read -r _; kill -s KILL -- "-$1"'


@contextlib.contextmanager
def bound(process: "subprocess.Popen[Any]") -> Iterator[None]:
    """End a process and its descendants with the context, or with this process, whichever comes first.

    It was started with `start_new_session=True`; descendants with a session of their own are not covered.
    """
    quiet = subprocess.DEVNULL
    watch = subprocess.Popen(
        ["/bin/sh", "-c", _WATCH, "sh", str(process.pid)],
        stdin=subprocess.PIPE,
        stdout=quiet,
        stderr=quiet,
        start_new_session=True,  # neither Ctrl-C nor a closed terminal is meant for it
    )
    try:
        yield
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        watch.kill()
        watch.communicate()
