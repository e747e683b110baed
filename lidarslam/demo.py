"""The demonstration: an indoor recording with turns on the spot, made here, and what becomes of it.

A tracked robot drives through a simulated office and turns on the spot at 120 deg/s. KISS-ICP expects the robot to go
on moving as it did, and loses the way; the same scans along a simulated wheel odometry, which drifts but does not
guess, make a map.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidarslam.config import load_config
from lidarslam.core.geometry import exp
from lidarslam.core.trajectory import Trajectory, chain
from lidarslam.core.trajectory_io import read_tum, write_tum
from lidarslam.finished_run import load_map
from lidarslam.picture import draw, height_colours, save_picture
from lidarslam.progress import show_count, show_progress
from lidarslam.run import RunOutcome, RunRequest, execute
from lidarslam.simulation.record import record
from lidarslam.simulation.recording_request import RecordRequest

RECORDING, WHEELS = "recording", "wheel_odometry.tum"
_KISS_ICP, _PRIOR = "kiss-icp", "wheel-odometry"

# What a decent wheel odometry gets wrong: 1 % of every step, and a twentieth of a degree a scan.
_STEP_ERROR = 0.01
_TURN_ERROR_DEG = 0.05


@dataclass(frozen=True)
class DemoRow:
    """One method of the demonstration."""

    name: str
    run: Path
    outcome: RunOutcome


def run_demo(out: Path, scans: int = 400, seed: int = 0) -> list[DemoRow]:
    """Record, run twice, draw the maps.

    Args:
        out: the folder everything goes to; an earlier demonstration in it is replaced.
        scans: how many sweeps are recorded, ten a second.
        seed: of the office, the drive and the noise.
    """
    source = out / RECORDING
    with show_count("recording") as counted:
        request = RecordRequest(
            source, "office", "vlp-16", "tracked", "upright", scans, seed, format="mcap", overwrite=True
        )
        record(request, counted)
    wheels = out / WHEELS
    write_tum(wheels, drifting(read_tum(source / "ground_truth.tum"), seed))
    external = load_config(None, ["odometry.method=external"])
    rows = [
        _run(
            _KISS_ICP,
            RunRequest(
                source,
                out / _KISS_ICP,
                load_config(None, ["odometry.method=kiss-icp", "mapping.enabled=false"]),
                rerun="save",
                overwrite=True,
            ),
        ),
        _run(_PRIOR, RunRequest(source, out / _PRIOR, external, prior=wheels, rerun="save", overwrite=True)),
    ]
    for name in (RECORDING, _KISS_ICP, _PRIOR):
        cloud = load_map(out / name)
        save_picture(out / f"{name}.png", draw(cloud.points, height_colours(cloud.points), cloud.normals))
    return rows


def drifting(truth: Trajectory, seed: int) -> Trajectory:
    """The true trajectory as wheels and a gyroscope would report it: every motion a little off."""
    rng = np.random.default_rng([seed, 1])
    motions = truth.relative_motions()
    steps = np.linalg.norm(motions[:, :3, 3], axis=1, keepdims=True)
    turns = np.deg2rad(_TURN_ERROR_DEG) * rng.standard_normal((len(motions), 3)) * [0.2, 0.2, 1.0]
    slips = _STEP_ERROR * steps * rng.standard_normal((len(motions), 3))
    return Trajectory(truth.stamps, chain(np.eye(4), motions @ exp(np.concatenate([turns, slips], axis=1))))


def format_demo(out: Path, rows: list[DemoRow]) -> str:
    """The table of the demonstration, and where to look."""
    return "\n".join(_lines(out, rows))


def _run(name: str, request: RunRequest) -> DemoRow:
    with show_progress(name) as progress:
        return DemoRow(name, request.out, execute(request, progress))


def _lines(out: Path, rows: list[DemoRow]) -> Iterator[str]:
    summary = rows[0].outcome.summary
    scans = f"{summary.scans} scans of a VLP-16, {summary.duration_s:.0f} s"
    yield f"a tracked robot turns on the spot in an office: {scans}"
    yield ""
    yield f"{'odometry':<16}{'ATE':>9}{'rotation':>11}{'lost scans':>12}{'ms a scan':>11}"
    for row in rows:
        metrics, total = row.outcome.metrics, row.outcome.summary.ms_per_scan["total"]
        assert metrics is not None
        yield (
            f"{row.name:<16}{metrics.errors.ate_rmse_m:>7.2f} m{metrics.errors.ate_rotation_rmse_deg:>7.1f} deg"
            f"{row.outcome.summary.lost_scans:>12}{total.median:>11.0f}"
        )
    yield ""
    yield "KISS-ICP expects the robot to go on moving as it did; a turn on the spot breaks that."
    yield ""
    yield f"maps      {out / RECORDING}.png (the truth), " + ", ".join(f"{row.run}.png" for row in rows)
    yield "look      lidarslam view " + " ".join(str(row.run) for row in rows)
    yield f"replay    rerun {rows[0].run / 'recording.rrd'}"
