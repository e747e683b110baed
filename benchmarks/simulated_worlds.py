"""KISS-ICP with its defaults on one simulated recording of every world and motion.

    python benchmarks/simulated_worlds.py

Prints a Markdown table: ATE in metres after SE(3) alignment, and the length of the path. Nothing is written to disk;
the scans go straight from the simulator into the pipeline of `lidarslam run`.
"""

import argparse
from collections.abc import Sequence

import numpy as np

from evaluation.trajectory_metrics import evaluate_trajectory
from lidarslam.core.trajectory import Trajectory
from lidarslam.localisation import OdometryAlone
from lidarslam.pipeline import Pipeline
from lidarslam.prefetch import prefetch
from lidarslam.simulation.carriers import CARRIERS
from lidarslam.simulation.mounts import mount_pose
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.route_motion import motion_along_route
from lidarslam.simulation.sensors import find_sensor
from lidarslam.simulation.worlds.registry import WORLDS, build_world
from mapping.config import GlobalMapConfig
from odometry.config import ConsistencyConfig, KissConfig
from odometry.consistency import ConsistencyCheck
from odometry.kiss import KissOdometry


def run_one(world: str, motion: str, sensor: str, scans: int, seed: int) -> str:
    """One cell of the table."""
    place = build_world(world, seed)
    carried = motion_along_route(motion, place, seed)
    T_body_lidar = mount_pose("upright", carried.sensor_height_m)
    recording = Simulation(place, find_sensor(sensor), carried, T_body_lidar, scans, seed)
    odometry = KissOdometry(KissConfig())
    try:
        pipeline = Pipeline(odometry, OdometryAlone(ConsistencyCheck(ConsistencyConfig())), GlobalMapConfig())
        results = list(pipeline.run(prefetch(recording.scans())))
    finally:
        odometry.close()
    stamps = np.array([result.stamp for result in results])
    estimate = Trajectory(stamps, np.array([result.T_world_lidar for result in results]))
    errors = evaluate_trajectory(estimate, recording.ground_truth).errors
    return f"{errors.ate_rmse_m:.2f} ({errors.length_m:.0f} m)"


def main() -> None:
    """Parse the command line and print the table, row by row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", nargs="+", choices=list(WORLDS), default=list(WORLDS))
    parser.add_argument("--motions", nargs="+", choices=list(CARRIERS), default=list(CARRIERS))
    parser.add_argument("--sensor", default="vlp-16")
    parser.add_argument("--scans", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    print_row(["world", *arguments.motions])
    print_row(["---"] * (1 + len(arguments.motions)))
    for world in arguments.worlds:
        cells = [
            run_one(world, motion, arguments.sensor, arguments.scans, arguments.seed) for motion in arguments.motions
        ]
        print_row([world, *cells])


def print_row(cells: Sequence[str]) -> None:
    """One row of a Markdown table."""
    print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
