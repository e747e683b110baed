"""KISS-ICP with its defaults on one simulated recording of every world and motion.

    python benchmarks/simulated_worlds.py

Prints a Markdown table: ATE in metres after SE(3) alignment, and the path length. The scans go in memory from the
simulator to the pipeline of `lidarslam run`; nothing is written to disk.
"""

from mapping_accuracy import add_simulation_arguments, make_parser, print_header, print_row, run_kiss, simulate

from lidarslam.odometry.config import KissConfig
from lidarslam.simulation.world import WORLDS


def main() -> None:
    parser = make_parser(__doc__)
    add_simulation_arguments(parser, worlds=list(WORLDS))
    arguments = parser.parse_args()
    print_header(["world", *arguments.motions])
    for world in arguments.worlds:
        chosen = [(world, motion, arguments.sensor, arguments.scans, arguments.seed) for motion in arguments.motions]
        outcomes = [run_kiss(simulate(*one), KissConfig()) for one in chosen]
        print_row([world, *(f"{outcome.ate_m:.2f} ({outcome.length_m:.0f} m)" for outcome in outcomes)])


if __name__ == "__main__":
    main()
