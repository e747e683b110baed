"""How long a whole run takes a scan, beside KISS-ICP's own loop on the same scans.

    python benchmarks/pipeline_speed.py KITTI/sequences/04
    python benchmarks/pipeline_speed.py --simulate hdl-64e:street:car --scans 100
    python benchmarks/pipeline_speed.py --simulate vlp-16:office:handheld --scans 400

Methods are named as for `lidarslam compare`. Ours go through the pipeline of `lidarslam run`, odometry on one thread
and mapping on another, scans from memory; the global map, which KISS-ICP does not make, is included. KISS-ICP's
`register_frame` runs in a plain loop, in a process of its own, with its defaults, on as many threads as it likes.
Methods take turns for `--rounds` rounds. Wall time and processor time of all threads are over all scans but the first
`--warm-up`, divided by their number; the ratio is to the KISS-ICP of the same round: its median, smallest and largest.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from mapping_accuracy import make_simulation, print_row

from lidarslam.compare.methods.names import parse_method
from lidarslam.config.settings import load_config
from lidarslam.core.scan import Scan
from lidarslam.datasets.registry import open_recording
from lidarslam.odometry.registry import make_odometry
from lidarslam.pipeline.localisation import make_localiser
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.pipeline.scan_stream import in_order
from lidarslam.run.loop_closing import FinishedGraph, begin_graph

_KISS = "KISS-ICP's own loop"
_FEW = 8
Timer = Callable[[], tuple[float, float]]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table for every recording."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="*", type=Path, help="recordings")
    parser.add_argument("--simulate", nargs="+", default=[], metavar="SENSOR:WORLD:MOTION")
    parser.add_argument("--methods", nargs="+", default=["learned+map", "constant-velocity+map", "learned+map+graph"])
    parser.add_argument("--scans", type=int, default=100)
    parser.add_argument("--warm-up", type=int, default=5)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args(arguments)
    for source in options.sources:
        recording = open_recording(source)
        _measure(recording.name, list(in_order(recording.scans(0, options.scans))), options)
    for named in options.simulate:
        sensor, world, motion = named.split(":")
        _measure(named, list(make_simulation(world, motion, sensor, options.scans, 0).scans()), options)


def _measure(name: str, scans: Sequence[Scan], options: argparse.Namespace) -> None:
    methods = [_KISS, *options.methods]
    for method in options.methods:  # loops are compiled when they are first called on a machine
        _run_ours(method, scans[:_FEW], 1)
    seconds: dict[str, list[tuple[float, float]]] = {method: [] for method in methods}
    for _ in range(options.rounds):
        for method in methods:
            is_kiss = method == _KISS
            seconds[method].append(
                _run_kiss(scans, options.warm_up) if is_kiss else _run_ours(method, scans, options.warm_up)
            )
    points = int(np.mean([len(scan) for scan in scans]))
    print(f"\n{name}: {len(scans)} scans of {points:,} points, {options.rounds} rounds\n")
    print_row(["method", "wall, ms a scan", "CPU, ms a scan", "wall / KISS-ICP's", "CPU / KISS-ICP's"])
    print_row(["---"] * 5)
    counted = len(scans) - options.warm_up
    kiss = np.array(seconds[_KISS])
    for method in methods:
        taken = np.array(seconds[method])
        ratios = [f"{np.median(r):.2f} [{r.min():.2f}, {r.max():.2f}]" for r in (taken / kiss).T]
        print_row([method, *(f"{1e3 * value / counted:.1f}" for value in np.median(taken, axis=0)), *ratios])


def _run_ours(method: str, scans: Sequence[Scan], warm_up: int) -> tuple[float, float]:
    config = load_config(None, parse_method(method).settings)
    odometry, graph = make_odometry(config.odometry), begin_graph(config)
    pipeline = Pipeline(odometry, make_localiser(config), config.global_map, graph)
    clock = _clock()
    for number, _ in enumerate(pipeline.run(scans)):
        if number + 1 == warm_up:
            clock = _clock()
    if pipeline.map.global_map is not None:
        pipeline.map.global_map.points()  # what waits to be merged is part of the work
    if graph is not None and pipeline.map.global_map is not None:
        finished = FinishedGraph.of_recordings(graph, [len(scans)], pipeline.map.global_map.voxel_size_m)
        assert finished is not None
        finished.outcome([0])
        graph.close()
    odometry.close()
    return clock()


def _run_kiss(scans: Sequence[Scan], warm_up: int) -> tuple[float, float]:
    """In a process of its own, where it has all the cores."""
    arrays = {f"points_{i}": scan.points for i, scan in enumerate(scans)}
    none = np.empty(0)
    arrays |= {f"times_{i}": none if scan.time_offsets is None else scan.time_offsets for i, scan in enumerate(scans)}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scans.npz"
        np.savez(file, **arrays)  # type: ignore[arg-type] # the stub takes them all for allow_pickle
        command = [sys.executable, str(Path(__file__).with_name("kiss_loop.py")), str(file), str(warm_up)]
        wall, cpu = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    return float(wall), float(cpu)


def _clock() -> Timer:
    """Tells wall and processor seconds since now."""
    wall, cpu = time.perf_counter(), time.process_time()
    return lambda: (time.perf_counter() - wall, time.process_time() - cpu)


if __name__ == "__main__":
    main()
