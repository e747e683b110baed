"""A merge whose recordings are tracked side by side has the files of a serial one, times apart."""

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lidarslam.config.settings import load_config
from lidarslam.core.errors import OutputError
from lidarslam.core.scan import Scan
from lidarslam.core.tasks import SERIAL, Where
from lidarslam.merge import parts as tracking
from lidarslam.merge.merge import merge
from lidarslam.merge.parts import MergeRequest
from lidarslam.merge.writing import MergeOutcome
from lidarslam.run.run import Progress

pytest.importorskip("ray")

SETTINGS = ["global_map.voxel_size_m=0.2", "odometry.method=constant-velocity", "checkpoints.every_scans=1"]
TIMES = 4  # that the room is crossed, so that a recording takes some seconds
Files = Callable[[Path], dict[str, Any]]


@contextmanager
def quiet(_name: str) -> Iterator[Progress]:
    """No progress bar."""
    yield lambda _number, _total, _result: None


def _merge(sources: list[Path], out: Path, where: Where, resume: bool = False) -> MergeOutcome:
    return merge(MergeRequest(tuple(sources), out, load_config(None, SETTINGS), resume=resume, where=where), quiet)


@pytest.fixture(scope="module")
def crossings(tmp_path_factory: pytest.TempPathFactory, room_scans: list[Scan]) -> list[Path]:
    """Three recordings of a way to and fro through the room, each with other points."""
    folders = []
    for number in range(3):
        folders.append(tmp_path_factory.mktemp("recordings") / f"crossing {number}")
        folders[-1].mkdir()
        scans = [scan for turn in range(TIMES) for scan in room_scans[:: 1 - 2 * (turn % 2)]]
        for index, scan in enumerate(scans):
            np.save(folders[-1] / f"{index:06d}.npy", scan.points[number::6])
        np.savetxt(folders[-1] / "timestamps.txt", 0.1 * np.arange(len(scans)), fmt="%.9f")
    return folders


@pytest.fixture(scope="module")
def serial(crossings: list[Path], tmp_path_factory: pytest.TempPathFactory, timeless: Files) -> dict[str, Any]:
    """The files of a serial merge."""
    out = tmp_path_factory.mktemp("merged") / "serial"
    _merge(crossings, out, SERIAL)
    return timeless(out)


def _wait_for(condition: Callable[[], bool], seconds: float = 300.0) -> None:
    until = time.monotonic() + seconds
    while not condition() and time.monotonic() < until:
        time.sleep(0.02)


@pytest.mark.long
def test_a_node_that_dies_costs_only_its_recordings(
    crossings: list[Path], tmp_path: Path, serial: dict[str, Any], timeless: Files
) -> None:
    """Two nodes with a CPU each; one is killed in the middle of a recording, after a checkpoint."""
    from ray.cluster_utils import Cluster

    out, cluster = tmp_path / "out", Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    nodes = [cluster.add_node(num_cpus=1) for _ in range(2)]

    def kill() -> None:
        _wait_for(lambda: any(map(_has_submaps_open, nodes)))
        cluster.remove_node(next(filter(_has_submaps_open, nodes)), allow_graceful=False)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    try:
        outcome = _merge(crossings, out, Where(cluster=cluster.address))
        killer.join(60.0)
    finally:
        cluster.shutdown()
    resumed = [warning for warning in outcome.summary.warnings if "the run was resumed once" in warning]
    assert len(resumed) == 1
    assert "after 0 scans" not in resumed[0]
    assert timeless(out) == serial


def _has_submaps_open(node: Any) -> bool:
    """Whether a worker of a node is past the first keyframe of a recording."""
    import psutil

    with contextlib.suppress(psutil.Error):
        workers = psutil.Process(node.all_processes["raylet"][0].process.pid).children(recursive=True)
        return any(file.path.endswith("submaps.bin") for worker in workers for file in worker.open_files())
    return False


@pytest.mark.slow
@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_ends_all_recordings_and_resume_goes_on(
    crossings: list[Path], tmp_path: Path, serial: dict[str, Any], timeless: Files
) -> None:
    out, whole = tmp_path / "out", TIMES * 20

    def interrupt() -> None:
        _wait_for(lambda: any(out.glob("*/unfinished/state.npz")))
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    outcome = _merge(crossings, out, Where(2))
    scans = [recording.scans for recording in outcome.summary.recordings]
    assert any(0 < count < whole for count in scans)
    assert scans[2] == 0
    assert outcome.stopped[-1].endswith("crossing 2: not begun")
    assert _merge(crossings, out, Where(2), resume=True).stopped == ()
    assert timeless(out) == serial


def test_a_directory_that_other_machines_do_not_have_is_said(crossings: list[Path], tmp_path: Path) -> None:
    config = load_config(None, SETTINGS)
    request = tracking.RunRequest(crossings[0], tmp_path / "out" / "01_crossing", config)
    with pytest.raises(OutputError, match="not shared by the nodes"):
        tracking.track_part(tracking.PartTask(request, "", {}, str(tmp_path), None))
    assert not (tmp_path / "out").exists()
