"""Methods of a comparison and recordings of a merge side by side: the files of a serial one but for times, here and on
a cluster that loses a node.
"""

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lidarslam.compare.comparison import CompareOutcome, compare
from lidarslam.compare.plan import CompareRequest, RecordingEntry, parse_methods
from lidarslam.config.settings import load_config
from lidarslam.core.errors import OutputError
from lidarslam.core.scan import Scan
from lidarslam.core.tasks import SERIAL, Where
from lidarslam.merge import merge as tracking
from lidarslam.merge.merge import MergeOutcome, MergeRequest, merge

from ..conftest import lidarslam
from .conftest import Told, quiet

pytest.importorskip("ray")

Files = Callable[..., dict[str, Any]]
METHODS = "constant-velocity+map,learned+map,prior"
# The files of a comparison that hold times, or the memory that was taken, throughout.
TIMED = ("process.json", "process.log", "report.html", "report.md")


def _compare(recording: Path, out: Path, where: Where, told: Told, *command: str, **changes: Any) -> CompareOutcome:
    entry = RecordingEntry(recording, prior=recording / "ground_truth.tum")
    request = CompareRequest(out, (entry,), parse_methods(METHODS), where=where, **changes)
    return compare(request, told, *((command,) if command else ()))


def _wait_for(condition: Any, seconds: float = 60.0) -> None:
    until = time.monotonic() + seconds
    while not condition() and time.monotonic() < until:
        time.sleep(0.05)


@contextmanager
def _two_nodes(doomed: Callable[[list[Any]], Any]) -> Iterator[Where]:
    """A cluster of two nodes with a CPU each, of which the doomed one is killed as soon as it is known."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    nodes = [cluster.add_node(num_cpus=1) for _ in range(2)]
    killer = threading.Thread(target=lambda: cluster.remove_node(doomed(nodes), allow_graceful=False), daemon=True)
    killer.start()
    try:
        yield Where(cluster=cluster.address)
        killer.join(60.0)
    finally:
        cluster.shutdown()


@pytest.mark.slow
def test_side_by_side_is_the_same_as_one_after_another(small_recording, tmp_path, timeless, told):
    _compare(small_recording, tmp_path / "serial", SERIAL, Told())
    serial = timeless(tmp_path / "serial", *TIMED)
    _compare(small_recording, tmp_path / "out", Where(2), told)
    assert timeless(tmp_path / "out", *TIMED) == serial
    assert told.counts[-1][1:] == (18, 18)
    assert len(told.lines) == 3
    again = Told()
    none = (sys.executable, "-c", "raise SystemExit('was run again')")
    _compare(small_recording, tmp_path / "out", Where(2), again, *none, reuse=True)
    assert all("in an earlier comparison" in line for line in again.lines)
    assert timeless(tmp_path / "out", *TIMED) == serial


@pytest.mark.slow
def test_a_simulated_recording_is_the_same_to_the_byte(tmp_path):
    for jobs in ("1", "2"):
        out = tmp_path / jobs / "walk"
        command = ["simulate", "--out", str(out), "--scans", "23", "--format", "ply", "--jobs", jobs]
        result = lidarslam(*command)
        assert result.exit_code == 0, result.output
    one, two = (
        {path.name: path.read_bytes() for path in (tmp_path / jobs / "walk").iterdir() if path.name != "README.md"}
        for jobs in ("1", "2")
    )
    assert len(one) == 26
    assert one == two


MERGED = ["global_map.voxel_size_m=0.2", "odometry.method=constant-velocity", "checkpoints.every_scans=1"]
TIMES = 4  # that the room is crossed, so that a recording takes some seconds


def _merge(sources: list[Path], out: Path, where: Where, resume: bool = False) -> MergeOutcome:
    return merge(MergeRequest(tuple(sources), out, load_config(None, MERGED), resume=resume, where=where), quiet)


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
def serial_merge(crossings: list[Path], tmp_path_factory: pytest.TempPathFactory, timeless: Files) -> dict[str, Any]:
    out = tmp_path_factory.mktemp("merged") / "serial"
    _merge(crossings, out, SERIAL)
    return timeless(out)


@pytest.mark.long
def test_a_node_that_dies_costs_a_merge_only_its_recordings(crossings, tmp_path, serial_merge, timeless):
    """One of the nodes is killed in the middle of a recording, after a checkpoint."""
    out = tmp_path / "out"

    def doomed(nodes: list[Any]) -> Any:
        _wait_for(lambda: any(map(_has_submaps_open, nodes)), seconds=300.0)
        return next(filter(_has_submaps_open, nodes))

    with _two_nodes(doomed) as where:
        outcome = _merge(crossings, out, where)
    resumed = [warning for warning in outcome.warnings if "the run was resumed once" in warning]
    assert len(resumed) == 1
    assert "after 0 scans" not in resumed[0]
    assert timeless(out) == serial_merge


def _has_submaps_open(node: Any) -> bool:
    """Whether a worker of a node is past the first keyframe of a recording."""
    import psutil

    with contextlib.suppress(psutil.Error):
        workers = psutil.Process(node.all_processes["raylet"][0].process.pid).children(recursive=True)
        return any(file.path.endswith("submaps.bin") for worker in workers for file in worker.open_files())
    return False


@pytest.mark.slow
@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_ends_all_recordings_of_a_merge_and_resume_goes_on(crossings, tmp_path, serial_merge, timeless):
    out, whole = tmp_path / "out", TIMES * 20

    def interrupt() -> None:
        _wait_for(lambda: any(out.glob("*/unfinished/state.npz")), seconds=300.0)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    outcome = _merge(crossings, out, Where(2))
    scans = [recording.scans for recording in outcome.recordings]
    assert any(0 < count < whole for count in scans)
    assert scans[2] == 0
    assert outcome.stopped[-1].endswith("crossing 2: not begun")
    assert _merge(crossings, out, Where(2), resume=True).stopped == ()
    assert timeless(out) == serial_merge


def test_a_directory_that_other_machines_do_not_have_is_said(crossings, tmp_path):
    config = load_config(None, MERGED)
    request = tracking.RunRequest(crossings[0], tmp_path / "out" / "01_crossing", config)
    with pytest.raises(OutputError, match="not shared by the nodes"):
        tracking.track_part(tracking.PartTask(request, "", {}, str(tmp_path), None))
    assert not (tmp_path / "out").exists()
