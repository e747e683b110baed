"""Shared fixtures of the application's tests."""

import hashlib
import json
import re
import resource
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory
from lidarslam.pipeline.estimates import ScanEstimate, SweepMotion
from lidarslam.run.run import Progress

from ..conftest import lidarslam, succeeds, write_recording
from .killable import Ended, serving

FAST = ("--odometry", "constant-velocity", "--no-report")


def refused(*arguments: object) -> str:
    """The one line of a command that ends with exit status 1."""
    result = lidarslam(*arguments)
    assert result.exit_code == 1, result.output
    assert result.stderr.startswith("lidarslam: ")
    assert result.stderr.count("\n") == 1
    return result.stderr


def ends_well(*arguments: object) -> Result:
    """A command that ends with a status, and with one line where that is 1."""
    result = lidarslam(*arguments)
    assert result.exit_code in (0, 1, 2, 3)
    assert "Traceback" not in result.output
    if result.exit_code == 1:
        assert result.stderr.startswith("lidarslam: ")
        assert len(result.stderr.splitlines()) == 1, result.stderr
        assert len(result.stderr) < 3000
    return result


@contextmanager
def files_no_longer_than(size: int) -> Iterator[None]:
    """A disk that is full after so many bytes of a file, as far as this process sees."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)


def summary_of(run: Path) -> dict[str, Any]:
    return dict(json.loads((run / "summary.json").read_text()))


def scan_estimate(stamp: float, T_world_lidar: FloatArray, status: Status = Status.OK, **values: Any) -> ScanEstimate:
    """A scan with a pose, with further values where they matter."""
    given: dict[str, Any] = {
        "T_odom_lidar": T_world_lidar,
        "covariance": None,
        "motion": SweepMotion(None, None),
        "message": "",
        "belongs_in_map": True,
        "points_used": 90,
        "residual_m": None,
        "inlier_ratio": None,
        "degenerate": (),
        "stage_ms": {},
        "is_odometry_asked": True,
        "points_read": 100,
        "points_dropped": 1,
    }
    return ScanEstimate(stamp=stamp, T_world_lidar=T_world_lidar, status=status, **given | values)


@contextmanager
def quiet(_name: str) -> Iterator[Progress]:
    """No progress bar."""
    yield lambda _number, _total, _result: None


class Told:
    """Keeps what a comparison tells: a line for each method, and how many scans of which were counted."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.counts: list[tuple[str, int, int]] = []

    @contextmanager
    def counting(self, name: str) -> Iterator[Callable[[int, int], None]]:
        yield lambda number, total: self.counts.append((name, number, total))

    def __call__(self, line: str) -> None:
        self.lines.append(line)


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> Told:
    told = Told()
    monkeypatch.setattr("lidarslam.compare.comparison.show_count", told.counting)
    return told


@pytest.fixture(scope="module")
def killable(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., Ended]]:
    """Carries out commands in processes of their own."""
    with serving(tmp_path_factory.mktemp("log") / "log") as carry_out:
        yield carry_out


@pytest.fixture(scope="session")
def timeless() -> Callable[..., dict[str, Any]]:
    """What every file of a run, merge or comparison holds, but for those of some names, large ones as a digest; without
    times, memory, and how often it was resumed.
    """

    def read(path: Path) -> Any:
        if path.name in ("summary.json", "comparison.json"):
            return _timeless(json.loads(path.read_text()))
        if path.name == "scans.csv":
            rows = [row.split(",") for row in path.read_text().splitlines()]
            timed = [column for column, title in enumerate(rows[0]) if title.startswith("ms_")]
            return [[cell for column, cell in enumerate(row) if column not in timed] for row in rows]
        return hashlib.sha256(path.read_bytes()).hexdigest()

    return lambda out, *left_out: {
        str(path.relative_to(out)): read(path)
        for path in out.rglob("*")
        if path.is_file() and path.name not in left_out
    }


def _timeless(tree: Any) -> Any:
    if isinstance(tree, dict):
        timed = re.compile(r"_ms|ms_|elapsed_s|wall_s|realtime|peak_rss|slowest|machine")
        return {name: _timeless(value) for name, value in tree.items() if not timed.search(name)}
    if isinstance(tree, list):
        return [_timeless(value) for value in tree if "the run was resumed" not in str(value)]
    return tree


@pytest.fixture(scope="session")
def small_recording(tmp_path_factory: pytest.TempPathFactory, room_scans: list[Scan], room_truth: Trajectory) -> Path:
    """Six scans with ground truth, not to be written to."""
    scans = [scan.select(np.arange(0, len(scan), 3)) for scan in room_scans[:6]]
    return write_recording(tmp_path_factory.mktemp("recordings") / "room", scans, room_truth)


@pytest.fixture(scope="session")
def whole_run(tmp_path_factory: pytest.TempPathFactory, small_recording: Path) -> Path:
    """A finished run of it, not to be written to."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    succeeds("run", small_recording, "--out", out, "--odometry", "constant-velocity")
    return out


@pytest.fixture
def finished_run(tmp_path: Path, whole_run: Path) -> Path:
    """A copy of a finished run."""
    return Path(shutil.copytree(whole_run, tmp_path / "run"))
