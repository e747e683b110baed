"""Independent tasks: the same results in this process, in several, and on a cluster of which a node dies."""

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from lidarslam.core.errors import ConfigError, InputError
from lidarslam.core.tasks import Tasks, Where, open_tasks

# What tasks run is imported by their processes: functions of the standard library and of this program.
in_processes = pytest.mark.parametrize("tasks", ["ray"], indirect=True)
SQUARES = [0.0, 1.0, 4.0, 9.0, 16.0]


class BadError(InputError):
    def __init__(self, first: str, second: int) -> None:
        super().__init__(f"{first} {second}")


def square(value: float) -> float:
    return value**2


def fail_at_three(value: float) -> float:
    if value == 3.0:
        raise BadError("three", 3)
    return value


def environment(name: str) -> str:
    return os.environ.get(name, "")


def interrupted(file: str) -> str:
    Path(file).touch()
    try:
        for _ in range(300):  # Ray interrupts between two steps of Python, not within one
            time.sleep(0.2)
    except KeyboardInterrupt:
        return "wrote its results"
    return "slept"


@pytest.fixture(params=["serial", "ray"], scope="module")
def tasks(request: pytest.FixtureRequest) -> Iterator[Tasks]:
    if request.param == "ray":
        # Ray pickles what is in this module whole: its processes cannot import a test.
        pytest.importorskip("ray.cloudpickle").register_pickle_by_value(sys.modules[__name__])
    with open_tasks(Where(2 if request.param == "ray" else 1)) as opened:
        yield opened


@pytest.mark.long
def test_results_are_in_order_whoever_is_first_and_an_error_of_a_task_is_that_of_the_user(tasks):
    done: list[tuple[int, float]] = []
    assert list(tasks.run(square, [0.0, 1.0, 2.0, 3.0, 4.0], lambda *one: done.append(one))) == SQUARES
    assert sorted(done) == list(enumerate(SQUARES))
    assert list(tasks.run(square, [0.0, 1.0, 2.0, 3.0, 4.0], ahead=2)) == SQUARES
    assert list(tasks.run(square, [])) == []
    with pytest.raises(InputError, match="three 3"):
        list(tasks.run(fail_at_three, [1.0, 2.0, 3.0, 4.0]))


@pytest.mark.long
@in_processes
def test_each_process_has_its_share_of_the_cores(tasks):
    share = os.environ.get("OMP_NUM_THREADS") or str(max(1, len(os.sched_getaffinity(0)) // 2))
    assert list(tasks.run(environment, ["OMP_NUM_THREADS", "NUMBA_NUM_THREADS"])) == [share, share]
    assert list(tasks.run(environment, ["RAY_USAGE_STATS_ENABLED"])) == ["0"]


@pytest.mark.long
@in_processes
@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_interrupts_all_tasks_and_takes_what_they_come_to(tasks, tmp_path):
    files = [str(tmp_path / name) for name in ("one", "two", "never begun")]

    def interrupt() -> None:
        while not (Path(files[0]).exists() and Path(files[1]).exists()):
            time.sleep(0.05)
        time.sleep(0.5)
        os.kill(os.getpid(), signal.SIGINT)

    done: dict[int, str] = {}
    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(KeyboardInterrupt):
        list(tasks.run(interrupted, files, done.__setitem__))
    assert done == {0: "wrote its results", 1: "wrote its results"}
    assert list(tasks.run(square, [3.0])) == [9.0]  # the processes serve on


def test_the_message_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.delitem(sys.modules, "lidarslam.core.tasks", raising=False)
    with pytest.raises(ConfigError, match=r"ray is not installed.* pip install 'lidarslam\[ray\]'"):
        open_tasks(Where(2))
    with open_tasks(Where(1)) as serial:
        assert list(serial.run(square, [2.0])) == [4.0]


def test_a_cluster_that_is_not_there_is_named():
    pytest.importorskip("ray")
    with pytest.raises(ConfigError, match=r"--ray 127.0.0.1:9: no cluster"), open_tasks(Where(cluster="127.0.0.1:9")):
        pass


def test_a_ray_that_does_not_start_is_told(monkeypatch):
    """On a busy machine it gives up, with an exception of no kind of its own."""
    pytest.importorskip("ray")

    def give_up(**_: object) -> None:
        raise Exception("The current node timed out during startup.")

    monkeypatch.setattr("ray.init", give_up)
    with pytest.raises(ConfigError, match="--jobs 2: Ray does not start: The current node"), open_tasks(Where(2)):
        pass
