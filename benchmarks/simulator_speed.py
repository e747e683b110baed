"""How fast the simulator makes sweeps: milliseconds each, and how many times faster than the sensor itself.

    python benchmarks/simulator_speed.py --world tunnel --motion tracked

Real time is a factor of 1. What is wanted on two cores: 1 or more for vlp-16, 0.2 or more for os1-128.
"""

import argparse
import time
from collections.abc import Iterator, Sequence
from statistics import median

from mapping_accuracy import in_world

from lidarslam.simulation.motion import CARRIERS
from lidarslam.simulation.sensors import SENSORS
from lidarslam.simulation.world import WORLDS, World, build_world


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table with a row for each sensor."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--world", default="tunnel", choices=WORLDS)
    parser.add_argument("--motion", default="handheld", choices=CARRIERS)
    parser.add_argument("--sensors", nargs="+", default=["vlp-16", "hdl-64e", "os1-128"], choices=SENSORS)
    parser.add_argument("--scans", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    world = build_world(options.world, options.seed)
    print(f"{'sensor':10}{'rays':>10}{'points':>10}{'ms a sweep':>12}{'factor':>8}")
    for row in _rows(world, options.motion, options.sensors, options.scans, options.seed):
        print(row, flush=True)


def _rows(world: World, motion_name: str, sensors: Sequence[str], scans: int, seed: int) -> Iterator[str]:
    for name in sensors:
        simulation = in_world(world, motion_name, name, scans + 1, seed)
        sensor = simulation.sensor
        simulation.scan(0)  # builds the scene
        seconds, points = [], []
        for index in range(1, scans + 1):
            start = time.perf_counter()
            points.append(len(simulation.scan(index).scan))
            seconds.append(time.perf_counter() - start)
        each = median(seconds)
        yield (
            f"{name:10}{sensor.pattern.columns * sensor.pattern.lasers:10,}{round(median(points)):10,}"
            f"{1e3 * each:12.1f}{sensor.period_s / each:8.1f}"
        )


if __name__ == "__main__":
    main()
