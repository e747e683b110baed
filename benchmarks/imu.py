"""Effect of an IMU: trajectories with and without it, evaluated by ground truth on the same scans.

    python benchmarks/imu.py --cases office/handheld hall/tracked-harsh --seeds 0 1 --scans 150
    python benchmarks/imu.py --cases office/handheld/3 --scans 300
    python benchmarks/imu.py 2011_09_26/2011_09_26_drive_0005_sync

A case is WORLD/MOTION, or WORLD/MOTION/STEP with every STEP-th scan; simulated recordings have a consumer MEMS unit
with noise and a random walk of the bias. Prints a Markdown table with a row per recording and method:

- ATE in metres after SE(3) alignment, and the largest height error after it;
- error of roll and pitch: RMS of the vertical about its mean, degrees;
- error of the turn from scan to scan: RMS, degrees;
- lost and degraded scans.

Every method runs in the pipeline of `lidarslam run` with its defaults, without a pose graph.
"""

import argparse
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
from mapping_accuracy import (
    BEYOND_TRUTH_S,
    Recorded,
    make_parser,
    make_simulation,
    print_header,
    print_row,
    read,
    trajectory_of,
)

from lidarslam.config.settings import Config
from lidarslam.core.geometry import FloatArray, inverse, rotation_angle, transform_points
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.registry import open_recording
from lidarslam.evaluation.trajectory.alignment import align
from lidarslam.evaluation.trajectory.metrics import evaluate_trajectory
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.inertial.inertial import Inertial
from lidarslam.odometry.config import OdometryConfig, OdometryName
from lidarslam.odometry.registry import make_odometry
from lidarslam.pipeline.localisation import make_localiser
from lidarslam.pipeline.pipeline import Pipeline

METHODS: dict[str, tuple[OdometryName, bool]] = {
    "KISS-ICP": ("kiss-icp", False),
    "constant-velocity+map": ("constant-velocity", True),
    "imu+map": ("imu", True),
    "learned+map": ("learned", True),
    "learned+imu+map": ("learned+imu", True),
}
_UP = np.array([0.0, 0.0, 1.0])


def simulate(case: str, scans: int, seed: int) -> Recorded:
    """A recording from the simulator, with every STEP-th scan."""
    world, motion, *step = case.split("/")
    simulation = make_simulation(world, motion, "vlp-16", scans, seed)
    every = int(step[0]) if step else 1
    name = f"{world}, {motion}, seed {seed}" + (f", {simulation.sensor.rate_hz / every:.1f} Hz" if step else "")
    return Recorded(name, list(simulation.scans(step=every)), simulation.ground_truth, simulation.imu)


def estimate(recorded: Recorded, config: Config) -> tuple[Trajectory, list[Status]]:
    """Trajectory of a method, and the status of each scan."""
    inertial, scans = None, recorded.scans
    if config.odometry.uses_imu:
        assert recorded.imu is not None, f"{recorded.name}: no IMU"
        assert recorded.imu.T_lidar_imu is not None, f"{recorded.name}: the mounting of the IMU is unknown"
        inertial = Inertial(recorded.imu, recorded.imu.T_lidar_imu)
        scans = [inertial.gyroscope.evened(scan) for scan in scans]
    with closing(make_odometry(config.odometry)) as odometry:
        results = list(Pipeline(odometry, make_localiser(config, inertial), config.global_map).run(scans))
    return trajectory_of(results), [result.status for result in results]


def vertical_error_deg(estimated: FloatArray, true: FloatArray) -> float:
    """RMS of the true vertical in the estimated world about its mean, for poses (N, 4, 4)."""
    ups = np.einsum("nij,nkj,k->ni", estimated[:, :3, :3], true[:, :3, :3], _UP)
    mean = ups.mean(axis=0)
    across = np.linalg.norm(np.cross(ups, mean / np.linalg.norm(mean)), axis=1)
    return float(np.rad2deg(np.sqrt((across**2).mean())))


def row(recorded: Recorded, method: str) -> list[str]:
    odometry, has_map = METHODS[method]
    config = Config(
        odometry=OdometryConfig(method=odometry), mapping=MappingConfig(method="surfels" if has_map else "off")
    )
    trajectory, statuses = estimate(recorded, config)
    errors = evaluate_trajectory(trajectory, recorded.truth).errors
    true = Trajectory(trajectory.stamps, recorded.truth.at(trajectory.stamps, BEYOND_TRUTH_S))
    aligned = transform_points(align(trajectory, true), trajectory.positions)
    height_m = float(np.abs(aligned - true.positions)[:, 2].max())
    tilt = vertical_error_deg(trajectory.T_world_lidar, true.T_world_lidar)
    turns = rotation_angle(inverse(trajectory.relative_motions()) @ true.relative_motions())
    turn = float(np.rad2deg(np.sqrt((turns**2).mean())))
    return [
        recorded.name,
        f"{errors.length_m:.0f}",
        method,
        f"{errors.ate_rmse_m:.3f}",
        f"{height_m:.3f}",
        f"{tilt:.2f}",
        f"{turn:.2f}",
        str(statuses.count(Status.LOST)),
        str(statuses.count(Status.DEGRADED)),
    ]


def recordings(arguments: argparse.Namespace) -> Iterator[Recorded]:
    """Recordings on disk, then simulated ones."""
    for source in arguments.sources:
        yield replace(read(source), imu=open_recording(source).imu)
    for case in arguments.cases:
        for seed in arguments.seeds:
            yield simulate(case, arguments.scans, seed)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("sources", nargs="*", type=Path, help="recordings with ground truth and IMU")
    parser.add_argument("--cases", nargs="*", default=[], metavar="WORLD/MOTION[/STEP]")
    parser.add_argument("--seeds", nargs="*", type=int, default=[0])
    parser.add_argument("--scans", type=int, default=300)
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=list(METHODS))
    arguments = parser.parse_args()
    columns = ["Recording", "Path, m", "Method", "ATE, m", "Height, m", "Roll, pitch, deg", "Turn, deg"]
    print_header([*columns, "Lost", "Degraded"])
    for recorded in recordings(arguments):
        for method in arguments.methods:
            print_row(row(recorded, method))


if __name__ == "__main__":
    main()
