"""LOAM's mapping from the command line: a run, a pose graph, a comparison."""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.trajectory import Trajectory, read_tum

from ..conftest import succeeds, write_recording

SCANS = 8


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory, room: Any, drive: Callable[[FloatArray], FloatArray]) -> Path:
    """Sweeps of a scanner with rings."""
    stamps = 0.1 * np.arange(1, SCANS + 1)
    scans, truth = (room.ring_sweep(drive, float(stamp)) for stamp in stamps), Trajectory(stamps, drive(stamps))
    return write_recording(tmp_path_factory.mktemp("recordings") / "room", scans, truth, is_timed=True)


def position_errors(run: Path, source: Path) -> FloatArray:
    """Distances (N,) of the run's positions from the truth, whose world is the first scan's frame."""
    truth, found = read_tum(source / "ground_truth.tum"), read_tum(run / "trajectory.tum")
    T = inverse(inverse(truth.T_world_lidar[0]) @ truth.T_world_lidar) @ found.T_world_lidar
    return np.asarray(np.linalg.norm(T[:, :3, 3], axis=1))


@pytest.mark.long
def test_a_run_with_loam(source: Path, tmp_path: Path) -> None:
    out, more = tmp_path / "run", ["--pose-graph", "--set", "pose_graph.keyframes.distance_m=0.2"]
    succeeds("run", source, "--out", out, "--odometry", "constant-velocity", "--mapping", "loam", *more)
    assert position_errors(out, source).max() < 0.03
    assert "method: loam" in (out / "config.yaml").read_text()
    with (out / "scans.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["ok"] * SCANS
    assert all(0 < int(row["points_used"]) < int(row["points"]) for row in rows[1:])
    assert (out / "map.ply").stat().st_size > 10_000
    assert (out / "pose_graph.g2o").exists()
