"""What a run keeps of every scan, when nothing new is to be seen: a sensor that stands still for hours.

    python benchmarks/log_memory.py
    python benchmarks/log_memory.py --scans 100000 --graph

A few hundred points a scan go through the pipeline of `lidarslam run`, without mapping, which logs them and saves its
state, in a temporary folder. Prints a Markdown table, a row every `--every` scans: resident memory of the process, size
of the saved state, and the wall time of a scan. Below it, what grew over the second half, in bytes a scan. The global
map merges its points after 20,000 instead of a million, or its saw teeth would hide everything else. Linux only: memory
is read from /proc.
"""

import argparse
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from mapping_accuracy import print_row
from mapping_memory import resident_mb

from lidarslam.config.settings import CheckpointConfig, Config, load_config
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.mapping.global_map import global_map
from lidarslam.odometry.methods.external import ExternalOdometry
from lidarslam.pipeline.localisation import make_localiser
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.pipeline.threads import prefetch
from lidarslam.run.checkpoints import Checkpoints
from lidarslam.run.loop_closing import begin_graph
from lidarslam.run.scan_log import ScanLog
from lidarslam.storage.directory import RunDirectory
from lidarslam.storage.unfinished import Unfinished

_POINTS = 300


def still(scans: int) -> Iterator[Scan]:
    """The walls of a room, always the same but for the noise."""
    rng = np.random.default_rng(0)
    axis, side = rng.integers(0, 3, _POINTS), rng.choice([-1.0, 1.0], _POINTS)
    walls = rng.uniform(-1.0, 1.0, (_POINTS, 3))
    walls[np.arange(_POINTS), axis] = side
    for number in range(scans):
        yield Scan(walls * [5.0, 4.0, 1.5] + 0.005 * rng.normal(size=walls.shape), 0.1 * number)


def watch(config: Config, scans: int, every: int) -> list[tuple[int, float, float]]:
    """Run, and print a row now and then; scans, and megabytes of memory and of saved state, of each."""
    samples: list[tuple[int, float, float]] = []
    with ExitStack() as stack:
        directory = stack.enter_context(RunDirectory.create(Path(stack.enter_context(TemporaryDirectory()))))
        unfinished = stack.enter_context(Unfinished.claim(directory, {}, resume=False))
        log = ScanLog()
        graph = begin_graph(config, file=unfinished.files.submaps)
        ends = Trajectory(np.array([0.0, 0.1 * scans]), np.tile(np.eye(4), (2, 1, 1)))
        odometry = ExternalOdometry(ends, largest_interval_s=np.inf)
        keeper = Checkpoints(unfinished, CheckpointConfig(every_scans=every // 2), odometry, log, graph)
        pipeline = Pipeline(odometry, make_localiser(config), config.global_map, graph, keeper)
        started = time.perf_counter()
        for number, result in enumerate(pipeline.run(prefetch(still(scans))), 1):
            log.add(result)
            if number % every:
                continue
            state_mb = unfinished.files.state.stat().st_size / 2**20
            samples.append((number, resident_mb(), state_mb))
            ms = 1e3 * (time.perf_counter() - started) / every
            print_row([f"{number:,}", f"{samples[-1][1]:.1f}", f"{state_mb:.2f}", f"{ms:.1f}"])
            started = time.perf_counter()
    return samples


def main() -> None:
    """Parse the command line, print the table and the growth."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=20_000)
    parser.add_argument("--every", type=int, default=2_000)
    parser.add_argument("--graph", action="store_true", help="with a pose graph")
    arguments = parser.parse_args()
    global_map._MIN_PENDING = 20_000
    settings = ["mapping.method=off", "global_map.voxel_size_m=0.1", f"pose_graph.enabled={arguments.graph}"]
    header = ["scans", "memory, MB", "state, MB", "ms a scan"]
    print_row(header)
    print_row(["---"] * len(header))
    samples = watch(load_config(None, settings), arguments.scans, arguments.every)
    half = np.array(samples[len(samples) // 2 :])
    if len(half) < 3:
        print("\nToo few rows to tell what grows.")
        return
    memory, state = (2**20 * np.polyfit(half[:, 0], half[:, column], 1)[0] for column in (1, 2))
    print(
        f"\nBy a straight line through the second half: {memory:.0f} bytes of memory and {state:.0f} of state a scan."
    )


if __name__ == "__main__":
    main()
