"""Memory of a run that loses tracking again and again, and begins a map anew each time, beside one that does not.

    python benchmarks/lost_memory.py
    python benchmarks/lost_memory.py --lost-every 600
    python benchmarks/lost_memory.py --points 20000 --scans 480 --every 48 --lost-every 48 [--keep-free]

A sensor stands in a room, made up as the scans are, and with `--lost-every` wakes up in another one every so many
scans, where after 20 lost scans a map begins. The scans go through the pipeline of `lidarslam run`. Prints a Markdown
table, a row every `--every` scans: resident memory of the process, the largest since the row before, cells of the local
map, points of the global map, scans lost and maps begun since the row before, and the wall time of a scan. With
`--keep-free`, free memory stays with the process. Linux only: memory is read from /proc.
"""

import argparse
import time
from collections.abc import Iterator

import numpy as np
from mapping_accuracy import print_row, without_odometry
from mapping_memory import resident_mb

from lidarslam.core.geometry import FloatArray, exp
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.odometry.registry import make_odometry
from lidarslam.pipeline import threads
from lidarslam.pipeline.localisation import ScanToMap
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.pipeline.threads import prefetch
from lidarslam.run.scan_log import ScanLog

_NOISE_M = 0.005
_VOXEL_M = 0.25


def room(rng: np.random.Generator, points: int) -> FloatArray:
    """Points (N, 3) on the walls of a room, as seen from somewhere in it."""
    half = rng.uniform([3.0, 3.0, 1.2], [6.0, 6.0, 2.0])
    walls = rng.uniform(-1.0, 1.0, (points, 3))
    walls[np.arange(points), rng.integers(0, 3, points)] = rng.choice([-1.0, 1.0], points)
    turn = rng.uniform(-np.pi, np.pi)
    R_world_room = exp(np.array([0.0, 0.0, turn, 0.0, 0.0, 0.0]))[:3, :3]
    return np.asarray((walls - rng.uniform(-0.6, 0.6, 3)) * half @ R_world_room.T)


def rooms(scans: int, points: int, lost_every: int | None) -> Iterator[Scan]:
    """One room, or one after another."""
    rng = np.random.default_rng(0)
    for number in range(scans):
        if number % (lost_every or scans) == 0:
            walls = room(rng, points)
        yield Scan(walls + _NOISE_M * rng.normal(size=walls.shape), 0.1 * number)


def watch(scans: int, points: int, lost_every: int | None, every: int) -> list[tuple[int, float]]:
    """Run, and print a row now and then; scans and megabytes of each."""
    config = without_odometry(MappingConfig())
    config = config.model_copy(update={"global_map": config.global_map.model_copy(update={"voxel_size_m": _VOXEL_M})})
    mapper = Mapper(config.mapping)  # as `lidarslam run` makes it, but in reach
    pipeline = Pipeline(make_odometry(config.odometry), ScanToMap(mapper), config.global_map)
    log, samples = ScanLog(), []
    lost = begun = 0
    most_mb, started = 0.0, time.perf_counter()
    for number, result in enumerate(pipeline.run(prefetch(rooms(scans, points, lost_every))), 1):
        log.add(result)
        lost, begun = lost + (result.status is Status.LOST), begun + ("a new map begins" in result.message)
        most_mb = max(most_mb, resident_mb())
        if number % every:
            continue
        cells = 0 if mapper.local_map is None else len(mapper.local_map)
        drawn = 0 if pipeline.map.global_map is None else len(pipeline.map.global_map.points())
        samples.append((number, resident_mb()))
        ms = 1e3 * (time.perf_counter() - started) / every
        row = [f"{number:,}", f"{samples[-1][1]:.0f}", f"{most_mb:.0f}", f"{cells:,}", f"{drawn:,}"]
        print_row([*row, str(lost), str(begun), f"{ms:.1f}"])
        lost, begun, most_mb, started = 0, 0, 0.0, time.perf_counter()
    return samples


def main() -> None:
    """Parse the command line, print the table and the growth."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=20_000)
    parser.add_argument("--points", type=int, default=1_000, help="of a scan")
    parser.add_argument("--lost-every", type=int, help="scans from one room to the next")
    parser.add_argument("--every", type=int, default=2_000)
    parser.add_argument("--keep-free", action="store_true")
    arguments = parser.parse_args()
    if arguments.keep_free:
        threads.EVERY_SCANS = arguments.scans + 1
    header = ["scans", "memory, MB", "most, MB", "cells", "map points", "lost", "maps begun", "ms a scan"]
    print_row(header)
    print_row(["---"] * len(header))
    samples = watch(arguments.scans, arguments.points, arguments.lost_every, arguments.every)
    half = np.array(samples[len(samples) // 2 :])
    if len(half) < 3:
        print("\nToo few rows to tell what grows.")
        return
    slope = 2**20 * np.polyfit(half[:, 0], half[:, 1], 1)[0]
    print(f"\nBy a straight line through the second half: {slope:.0f} bytes of memory a scan.")


if __name__ == "__main__":
    main()
