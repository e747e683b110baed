"""Time of whole runs per scan, compared with KISS-ICP's own loop and other peers on the same scans.

    python benchmarks/pipeline_speed.py KITTI/sequences/04
    python benchmarks/pipeline_speed.py --simulate hdl-64e:street:car vlp-16:street:car os1-128:street:car --scans 100
    python benchmarks/pipeline_speed.py --simulate vlp-16:office:handheld --scans 400 --peers mad-icp small-gicp

Methods are named as for `lidarslam compare`. Ours run in the pipeline of `lidarslam run`, each stage on its own thread;
the global map, which the others do not build, is included, and for recordings reading the files. KISS-ICP's
`register_frame` runs in a plain loop over scans in memory, in a separate process, with its defaults and any number of
threads; so do the peers (`pip install 'lidarslam[peers]'`), of which only the registration is timed.

Methods alternate for `--rounds` rounds. Wall and CPU time are over all scans but the first `--warm-up`, divided by
their number; the ratio is to KISS-ICP in the same round: median, smallest and largest. The median and the 99th
percentile are of single scans: of ours the sum of the stages, which work on several scans at once. The median of each
stage follows the table.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mapping_accuracy import in_process, make_parser, make_simulation, print_header, print_row
from numpy.typing import NDArray

from lidarslam.compare.peers.estimation import PEERS, estimate
from lidarslam.compare.plan import parse_method
from lidarslam.config.settings import load_config
from lidarslam.core.scan import Scan
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.registry import open_recording
from lidarslam.pipeline.localisation import make_localiser
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.pipeline.threads import in_order, prefetch
from lidarslam.run.loop_closing import FinishedGraph, begin_graph
from lidarslam.run.run import open_odometry

_KISS = "KISS-ICP's own loop"
_FEW = 8
Timer = Callable[[], tuple[float, float]]
Scans = Callable[[], Iterable[Scan]]


@dataclass(frozen=True)
class Times:
    """Seconds of one run after its warm-up."""

    wall: float
    processor: float  # CPU of all threads; NaN where it cannot be separated from other work
    scan_ms: list[float]  # of single scans
    stage_ms: dict[str, list[float]] = field(default_factory=dict)  # of the stages of ours, of single scans


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("sources", nargs="*", type=Path, help="recordings")
    parser.add_argument("--simulate", nargs="+", default=[], metavar="SENSOR:WORLD:MOTION")
    parser.add_argument("--methods", nargs="+", default=["learned+map", "constant-velocity+map", "learned+map+graph"])
    parser.add_argument("--peers", nargs="*", default=[])
    parser.add_argument("--scans", type=int, default=100)
    parser.add_argument("--warm-up", type=int, default=5)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    for source in options.sources:
        recording = open_recording(source)
        scans = list(in_order(recording.scans(0, options.scans)))
        _measure(recording.name, scans, partial(_read, recording, options.scans), options)
    for named in options.simulate:
        sensor, world, motion = named.split(":")
        scans = list(make_simulation(world, motion, sensor, options.scans, 0).scans())
        _measure(named, scans, partial(iter, scans), options)


def _read(recording: Recording, count: int) -> Iterator[Scan]:
    """The scans as read by a run."""
    return prefetch(in_order(recording.scans(0, count)))


def _measure(name: str, scans: Sequence[Scan], source: Scans, options: argparse.Namespace) -> None:
    for method in options.methods:  # compiles loops
        _run_ours(method, scans[:_FEW], 1)
    with tempfile.TemporaryDirectory() as folder:
        file = _saved(scans, Path(folder))
        runs: dict[str, Callable[[], Times]] = {_KISS: partial(_run_kiss, file, options.warm_up)}
        runs |= {method: partial(_run_source, method, source, options.warm_up) for method in options.methods}
        for peer in options.peers:
            runs[peer] = partial(in_process, _run_peer, peer, file, options.warm_up)
        rounds = [{method: run() for method, run in runs.items()} for _ in range(options.rounds)]
    points = int(np.mean([len(scan) for scan in scans]))
    print(f"\n{name}: {len(scans)} scans of {points:,} points, {options.rounds} rounds\n")
    print_header(
        ["method", "wall, ms per scan", "median", "p99", "CPU, ms per scan", "wall / KISS-ICP's", "CPU / KISS-ICP's"]
    )
    counted = len(scans) - options.warm_up
    for method in runs:
        taken = np.array([[times[method].wall, times[method].processor] for times in rounds])
        kiss = np.array([[times[_KISS].wall, times[_KISS].processor] for times in rounds])
        of_scans = np.median([np.percentile(times[method].scan_ms, [50, 99]) for times in rounds], axis=0)
        wall, processor = 1e3 * np.median(taken, axis=0) / counted
        ratios = [f"{np.median(r):.2f} [{r.min():.2f}, {r.max():.2f}]" for r in (taken / kiss).T]
        shown = [wall, *of_scans, processor]
        print_row([method, *(_blank_nan(f"{value:.1f}") for value in shown), *(_blank_nan(ratio) for ratio in ratios)])
    for method in options.methods:
        stages = {stage: [times[method].stage_ms[stage] for times in rounds] for stage in rounds[0][method].stage_ms}
        medians = (f"{stage} {np.median(np.concatenate(ms)):.1f}" for stage, ms in stages.items())
        print(f"\n{method}, ms: {', '.join(medians)}")


def _blank_nan(text: str) -> str:
    return "" if "nan" in text else text


def _run_source(method: str, source: Scans, warm_up: int) -> Times:
    return _run_ours(method, source(), warm_up)


def _run_ours(method: str, scans: Iterable[Scan], warm_up: int) -> Times:
    config = load_config(None, parse_method(method).settings)
    odometry, graph = open_odometry(config, None), begin_graph(config)
    pipeline = Pipeline(odometry, make_localiser(config), config.global_map, graph)
    clock, results = _clock(), []
    for result in pipeline.run(scans):
        results.append(result.stage_ms)
        if len(results) == warm_up:
            clock = _clock()
    if pipeline.map.global_map is not None:
        pipeline.map.global_map.points()  # merging the pending points is part of the work
    if graph is not None and pipeline.map.global_map is not None:
        optimised = graph.finish()
        assert optimised is not None
        FinishedGraph(graph, optimised, pipeline.map.global_map.voxel_size_m).outcome([0])
        graph.close()
    odometry.close()
    counted = results[warm_up:]
    stage_ms = {stage: [times[stage] for times in counted] for stage in counted[0]} if counted else {}
    return Times(*clock(), [sum(times.values()) - times["read"] for times in counted], stage_ms)


def _saved(scans: Sequence[Scan], folder: Path) -> Path:
    """The scans in a file, for separate processes."""
    arrays: dict[str, NDArray[Any]] = {f"points_{i}": scan.points for i, scan in enumerate(scans)}
    none = np.empty(0)
    arrays |= {f"times_{i}": none if scan.time_offsets is None else scan.time_offsets for i, scan in enumerate(scans)}
    arrays |= {f"rings_{i}": none if scan.rings is None else scan.rings for i, scan in enumerate(scans)}
    arrays["stamps"] = np.array([scan.stamp for scan in scans])
    np.savez(folder / "scans.npz", **arrays)  # type: ignore[arg-type] # the stub takes them all for allow_pickle
    return folder / "scans.npz"


def _run_kiss(file: Path, warm_up: int) -> Times:
    """KISS-ICP's loop in a separate process, where it has all cores."""
    command = [sys.executable, str(Path(__file__).with_name("kiss_loop.py")), str(file), str(warm_up)]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return Times(**json.loads(printed.splitlines()[-1]))


def _run_peer(name: str, file: Path, warm_up: int) -> Times:
    """A peer's registration; its conversion of scans is not timed, so that its CPU time is unknown."""
    scan_ms = list(estimate(PEERS[name], saved_scans(file)).register_ms.values())[warm_up:]
    return Times(sum(scan_ms) / 1e3, float("nan"), scan_ms)


def _clock() -> Timer:
    """Wall and CPU seconds since now."""
    wall, cpu = time.perf_counter(), time.process_time()
    return lambda: (time.perf_counter() - wall, time.process_time() - cpu)


def saved_scans(file: Path) -> Iterator[Scan]:
    """The scans of a file of `_saved`."""
    arrays = np.load(file)
    for i, stamp in enumerate(arrays["stamps"].tolist()):
        times, rings = arrays[f"times_{i}"], arrays[f"rings_{i}"]
        yield Scan(arrays[f"points_{i}"], stamp, times if len(times) else None, rings if len(rings) else None)


if __name__ == "__main__":
    main()
