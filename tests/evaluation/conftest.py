"""Trajectories of known shape, and a comparison of methods with everything a report has to cope with."""

from collections.abc import Callable

import numpy as np
import pytest

from lidarslam.core.geometry import exp
from lidarslam.core.trajectory import Trajectory, chain
from lidarslam.evaluation.comparison.comparison import (
    Comparison,
    MethodResult,
    MissingRecording,
    SequenceComparison,
    Table,
    TableCell,
    TableColumn,
    TableRow,
)
from lidarslam.evaluation.map.metrics import CloudErrors
from lidarslam.evaluation.trajectory.metrics import evaluate_trajectory

HOSTILE = "<script>alert('x')</script> & \"quoted\" | `tick` ünïcode 测试 \x00"


@pytest.fixture
def random_drive() -> Callable[..., Trajectory]:
    """A vehicle's drive: about a metre a scan at 10 Hz, turning, with a little pitch and roll; from a seed."""

    def drive(seed: int, scans: int = 400, step_m: float = 1.0) -> Trajectory:
        rng = np.random.default_rng(seed)
        yaw_rate = np.convolve(rng.normal(0.0, 0.08, scans - 1), np.ones(20) / 20.0, mode="same")
        xi = rng.normal(0.0, 0.003, (scans - 1, 6))
        xi[:, 2] += yaw_rate
        xi[:, 3] += step_m * rng.uniform(0.7, 1.3, scans - 1)
        return Trajectory(100.0 + 0.1 * np.arange(scans), chain(np.eye(4), exp(xi)))

    return drive


@pytest.fixture
def straight_drive() -> Callable[..., Trajectory]:
    """A drive along x at constant speed and 10 Hz, `T_prev_curr` of each scan given by a tangent vector."""

    def drive(scans: int, xi: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0)) -> Trajectory:
        return Trajectory(0.1 * np.arange(scans), exp(np.arange(scans)[:, None] * np.array(xi)))

    return drive


@pytest.fixture
def noisy() -> Callable[..., Trajectory]:
    """The same trajectory with each relative motion disturbed, so that it drifts."""

    def disturb(trajectory: Trajectory, seed: int, sigma: float = 0.005) -> Trajectory:
        noise = np.random.default_rng(seed).normal(0.0, sigma, (len(trajectory) - 1, 6))
        motions = trajectory.relative_motions() @ exp(noise * [0.1, 0.1, 0.1, 1.0, 1.0, 1.0])
        return Trajectory(trajectory.stamps, chain(trajectory.T_world_lidar[0], motions))

    return disturb


@pytest.fixture
def finished(noisy) -> Callable[..., MethodResult]:
    """A method's result beside the reference it was disturbed from."""

    def result(name: str, reference: Trajectory, seed: int, sigma: float = 0.01, **others: object) -> MethodResult:
        estimate = noisy(reference, seed, sigma).transformed(exp([0.1, -0.2, 1.0, 5.0, 6.0, 7.0]))
        given = {
            "status": "ok",
            "scans": len(estimate),
            "trajectory": estimate,
            "lost": np.zeros(len(estimate), dtype=bool),
            "metrics": evaluate_trajectory(estimate, reference),
            "elapsed_ms_per_scan": 12.0 + seed,
            "latency_ms_median": 20.0 + seed,
            "latency_ms_p99": 30.0 + seed,
            "ms_per_scan_median": 10.0 + seed,
            "ms_per_scan_p95": 14.0 + seed,
            "stage_ms": {"odometry": 8.0, "refinement": 2.5},
            "peak_rss_mb": 500.0 + seed,
            "wall_s": 12.0,
            "settings": f"method: {name}\n",
        }
        return MethodResult(name, **{**given, **others})

    return result


@pytest.fixture
def comparison(random_drive, straight_drive, finished, rng) -> Comparison:
    """Two recordings; methods that are good, lost, stopped, failed and without metrics; hostile names and messages."""
    street, corridor = random_drive(1, scans=900), random_drive(2, scans=300, step_m=0.2)
    lost = np.zeros(len(street), dtype=bool)
    lost[100:120] = lost[500] = True
    walls = CloudErrors(rng.uniform(-5.0, 5.0, (2000, 3)), np.abs(rng.normal(0.0, 0.1, 2000)))
    map_metrics = {
        "accuracy_mean_m": 0.0312,
        "completeness_mean_m": 0.0456,
        "chamfer_m": 0.0384,
        "f_score_percent": {"0.1": 81.2, "0.2": 93.4, "0.5": None},
        "coverage_percent": {"1.0": 99.5},
        "deviation_percent": {"1.0": 0.4},
    }
    first = [
        finished("learned", street, 3, 0.02, status="lost", lost=lost, message=f"no overlap {HOSTILE}"),
        finished("kiss-icp", street, 4, 0.004, map_errors=walls, map_metrics=map_metrics),
        MethodResult(HOSTILE, "failed", f"ended with signal 11 {HOSTILE}"),
    ]
    second = [
        finished("kiss-icp", corridor, 5, 0.003),
        finished("learned", corridor, 6, 0.01, status="stopped", message="interrupted"),
        finished("unmeasured", corridor, 7, metrics=None),
    ]
    columns = [TableColumn(name, "t_rel", "%", 2, True, of) for name, of in (("09", ("09",)), ("00-08", ("00", "01")))]
    rows = [
        TableRow("learned", [TableCell(1.234, 1), TableCell(0.111, 1, "over 1 of 2", ranked=False)]),
        TableRow("kiss-icp", [TableCell(0.567, 1), TableCell(0.333, 2)]),
        TableRow("DeLORA", [TableCell(6.05, 1), TableCell("NA", 2)], source="Nubert et al., ICRA 2021"),
    ]
    return Comparison(
        title=f"Title {HOSTILE}",
        command=f"lidarslam compare 'a b' --methods {HOSTILE}",
        sequences=[
            SequenceComparison(
                f"street {HOSTILE}", "/data/street", street, "ground truth", first, (f"note {HOSTILE}",)
            ),
            SequenceComparison("corridor", "/data/corridor", corridor, "ground truth", second),
        ],
        versions={"lidarslam": "0.1.0", "commit": "0123abc"},
        machine={"processor": f"some {HOSTILE}", "cores": "8"},
        tables=[Table(f"Means {HOSTILE}", columns, rows, "a note")],
        missing=[MissingRecording("03", "/data/03", "holds no scans")],
        notes=["interrupted"],
    )
