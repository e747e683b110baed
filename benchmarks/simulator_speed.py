"""Speed of the simulator: milliseconds per sweep, and the factor over real time.

    python benchmarks/simulator_speed.py --world tunnel --motion tracked

A factor of 1 is real time. Targets on two cores: 1 or more for vlp-16, 0.2 or more for os1-128.
"""

import time
from statistics import median

from mapping_accuracy import in_world, make_parser

from lidarslam.simulation.motion import CARRIERS
from lidarslam.simulation.world import WORLDS, build_world

_SENSORS, _SCANS = ("vlp-16", "hdl-64e", "os1-128"), 30


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--world", default="tunnel", choices=WORLDS)
    parser.add_argument("--motion", default="handheld", choices=CARRIERS)
    options = parser.parse_args()
    world = build_world(options.world, 0)
    print(f"{'sensor':10}{'rays':>10}{'points':>10}{'ms/sweep':>12}{'factor':>8}")
    for name in _SENSORS:
        simulation = in_world(world, options.motion, name, _SCANS + 1, 0)
        sensor = simulation.sensor
        simulation.scan(0)  # builds the scene
        seconds, points = [], []
        for index in range(1, _SCANS + 1):
            start = time.perf_counter()
            points.append(len(simulation.scan(index).scan))
            seconds.append(time.perf_counter() - start)
        each = median(seconds)
        print(
            f"{name:10}{sensor.pattern.columns * sensor.pattern.lasers:10,}{round(median(points)):10,}"
            f"{1e3 * each:12.1f}{sensor.period_s / each:8.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
