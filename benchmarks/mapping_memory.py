"""Whether a long run takes more and more memory: a sensor goes round and round in a bounded place.

    python benchmarks/mapping_memory.py
    python benchmarks/mapping_memory.py --world hall --motion tracked --scans 20000
    python benchmarks/mapping_memory.py --scans 20000 --columns 200

The scans go straight from the simulator into the pipeline of `lidarslam run`, which logs them and saves its state now
and then, in a temporary folder. Prints a Markdown table, a row every `--every` scans: resident memory of the process,
size of the saved state, cells of the local map, points of the global map, scans lost and degraded since the row before,
how far the pose is from the truth (the first poses put together), and the wall time of a scan, simulator included.
Below it, what grew over the second half, by when every place has been seen. Linux only: memory is read from /proc.
"""

import argparse
import os
import time
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from mapping_accuracy import make_simulation, print_row, without_odometry

from lidarslam.core.geometry import inverse
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.odometry.registry import make_odometry
from lidarslam.pipeline.estimates import ScanResult
from lidarslam.pipeline.localisation import ScanToMap
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.pipeline.threads import prefetch
from lidarslam.run.checkpoints import Checkpoints
from lidarslam.run.scan_log import ScanLog
from lidarslam.simulation.motion import CARRIERS
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.sensors import SENSORS, Spinning
from lidarslam.simulation.world import WORLDS
from lidarslam.storage.directory import RunDirectory
from lidarslam.storage.unfinished import Unfinished


@dataclass(frozen=True)
class Sample:
    """How things stand after so many scans."""

    scans: int
    rss_mb: float
    state_mb: float
    cells: int
    map_points: int


def watch(simulation: Simulation, every: int) -> list[Sample]:
    """Run, and print a row now and then."""
    config = without_odometry(MappingConfig())
    mapper = Mapper(config.mapping)  # as `lidarslam run` makes it, but in reach
    samples: list[Sample] = []
    with ExitStack() as stack:
        directory = stack.enter_context(RunDirectory.create(Path(stack.enter_context(TemporaryDirectory()))))
        unfinished = stack.enter_context(Unfinished.claim(directory, {}, resume=False))
        log = ScanLog()
        odometry = make_odometry(config.odometry)
        checkpoints = Checkpoints(unfinished, config.checkpoints, odometry, log, None)
        pipeline = Pipeline(odometry, ScanToMap(mapper), config.global_map, checkpointer=checkpoints)
        _follow(simulation, every, pipeline, mapper, log, unfinished, samples)
    return samples


def _follow(
    simulation: Simulation,
    every: int,
    pipeline: Pipeline,
    mapper: Mapper,
    log: ScanLog,
    unfinished: Unfinished,
    samples: list[Sample],
) -> None:
    statuses: Counter[Status] = Counter()
    started = time.perf_counter()
    for number, result in enumerate(pipeline.run(prefetch(simulation.scans())), 1):
        log.add(result)
        statuses[result.status] += 1
        if number % every:
            continue
        rss_mb = resident_mb()
        cells = 0 if mapper.local_map is None else len(mapper.local_map)
        points = 0 if pipeline.map.global_map is None else len(pipeline.map.global_map.points())
        state_mb = unfinished.files.state.stat().st_size / 2**20 if unfinished.files.state.exists() else 0.0
        sample = Sample(number, rss_mb, state_mb, cells, points)
        samples.append(sample)
        print_row([
            f"{number:,}",
            f"{number / simulation.sensor.rate_hz / simulation.motion.duration_s:.1f}",
            f"{sample.rss_mb:.0f}",
            f"{sample.state_mb:.1f}",
            f"{cells:,}",
            f"{points:,}",
            str(statuses[Status.LOST]),
            str(statuses[Status.DEGRADED]),
            f"{_error_m(simulation, result):.2f}",
            f"{1e3 * (time.perf_counter() - started) / every:.1f}",
        ])  # fmt: skip
        statuses.clear()
        started = time.perf_counter()


def resident_mb() -> float:
    """Resident memory of this process, 1024 x 1024 bytes each."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def _error_m(simulation: Simulation, result: ScanResult) -> float:
    T_world_first, T_world_lidar = simulation.T_world_lidar_at(np.array([0.0, result.stamp]))
    return float(np.linalg.norm((inverse(T_world_first) @ T_world_lidar - result.T_world_lidar)[:3, 3]))


def growth(samples: list[Sample]) -> str:
    """What changed over the second half, in words."""
    half = [sample for sample in samples if 2 * sample.scans >= samples[-1].scans]
    if len(half) < 3:
        return "Too few rows to tell what grows."
    scans = np.array([sample.scans for sample in half])

    def slope(values: list[float]) -> float:
        return 1000.0 * float(np.polyfit(scans, values, 1)[0])

    return (
        f"From scan {half[0].scans:,} to {half[-1].scans:,}: {half[-1].rss_mb - half[0].rss_mb:+.1f} MB,"
        f" {half[-1].cells - half[0].cells:+,} cells, {half[-1].map_points - half[0].map_points:+,} points;"
        f" a straight line through the rows rises by {slope([sample.rss_mb for sample in half]):.2f} MB"
        f" ({1048.576 * slope([sample.rss_mb for sample in half]):.0f} bytes a scan),"
        f" {slope([sample.state_mb for sample in half]):.2f} MB of saved state,"
        f" {slope([sample.cells for sample in half]):.0f} cells"
        f" and {slope([sample.map_points for sample in half]):.0f} points every 1,000 scans."
    )


def main() -> None:
    """Parse the command line, print the table and the growth."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--world", choices=list(WORLDS), default="office")
    parser.add_argument("--motion", choices=list(CARRIERS), default="handheld")
    parser.add_argument("--sensor", choices=list(SENSORS), default="vlp-16")
    parser.add_argument("--scans", type=int, default=10_000)
    parser.add_argument("--columns", type=int, help="of a turn, to make less of a spinning sensor")
    parser.add_argument("--every", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    simulation = make_simulation(arguments.world, arguments.motion, arguments.sensor, arguments.scans, arguments.seed)
    if arguments.columns is not None:
        sensor = simulation.sensor
        if not isinstance(sensor.pattern, Spinning):
            parser.error(f"--columns: {sensor.name} does not spin")
        thinner = replace(sensor, pattern=replace(sensor.pattern, columns=arguments.columns))
        simulation = replace(simulation, sensor=thinner)
    header = [
        "scans",
        "laps",
        "memory, MB",
        "state, MB",
        "cells",
        "map points",
        "lost",
        "degraded",
        "error, m",
        "ms a scan",
    ]
    print_row(header)
    print_row(["---"] * len(header))
    samples = watch(simulation, arguments.every)
    print(f"\n{growth(samples)}" if samples else "\nFewer scans than a row.")


if __name__ == "__main__":
    main()
