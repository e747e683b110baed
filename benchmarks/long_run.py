"""Stability and accuracy over a run of 20,000 scans and 20 km with loops, compared with peers.

    python benchmarks/long_run.py --out long_run
    python benchmarks/long_run.py --out long_run --scans 3000 --odometry learned --peers

A car drives through every street of the simulated `town` in both directions, then again. A separate process simulates;
the scans are passed in memory to the pipeline of `lidarslam run` with its pose graph, which saves checkpoints, and to
each peer in a separate process. No scan is stored, and all methods have the same scans.

Prints a Markdown table with a row every `--every` scans: wall time per scan of all stages but reading, median and 99th
percentile since the previous row; the same of keyframes, on the graph's thread; CPU time of the whole process per scan;
resident memory; size of the checkpoint, and seconds to save it; size on disk of the submaps and of the tiles of the
global map; cells of the local map, voxels of the global map in memory, keyframes, accepted loops; position error as
registered. Then the time of the final optimisation and of rebuilding the map, and ATE and KITTI drift of all methods.
The rows are saved in `rows.jsonl` and those of the peers in `NAME.jsonl` during the run, the final results in
`end.json`; `benchmarks/long_run_plot.py` plots them. A file `stop` in the folder ends the drive early, with all results
for the scans so far.

Linux only: memory is read from /proc.
"""

import argparse
import json
import logging
import multiprocessing
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, replace
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from mapping_accuracy import make_parser, make_simulation, print_header, print_row
from memory import resident_mb

from lidarslam.compare.peers.estimation import PEERS, Peer, estimate
from lidarslam.compare.peers.interface import Poses, Sweep
from lidarslam.config.settings import Config
from lidarslam.core.errors import LidarSlamError
from lidarslam.core.geometry import inverse
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.evaluation.trajectory.metrics import TrajectoryMetrics, evaluate_trajectory
from lidarslam.mapping.config import GlobalMapConfig, PoseGraphConfig
from lidarslam.mapping.global_map.voxels import TileStore
from lidarslam.mapping.pose_graph.slam_graph import SlamGraph
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.odometry.config import OdometryConfig
from lidarslam.pipeline.localisation import make_localiser
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.pipeline.threads import prefetch
from lidarslam.run.checkpoints import Checkpoints
from lidarslam.run.loop_closing import begin_graph
from lidarslam.run.run import open_odometry
from lidarslam.run.summary import ScanLog
from lidarslam.simulation.sensors import Spinning
from lidarslam.storage.directory import STATE, SUBMAPS, TILES, RunDirectory, Unfinished

_HEADER = (
    "scans", "km", "wall, ms: median", "p99", "keyframes, ms: median", "p99", "CPU, ms per scan", "memory, MB",
    "checkpoint, MB", "saving, s", "submaps on disk, MB", "tiles on disk, MB", "cells", "voxels in memory", "keyframes",
    "loops", "error as registered, m",
)  # fmt: skip
# Limit of the global map in memory.
_MOST_POINTS = 2_000_000
# Message to a peer after the last scan.
_END = None


class KissIcpEstimator:
    """KISS-ICP's own loop, `register_frame` with its defaults, as a peer."""

    def __init__(self) -> None:
        from kiss_icp.config.parser import load_config
        from kiss_icp.kiss_icp import KissICP

        self._kiss: Any = KissICP(load_config(None))
        self._poses: list[Any] = []
        self._instants: list[float] = []

    def add_imu(self, samples: ImuSamples, number: int) -> None:
        """KISS-ICP uses no IMU."""

    def load(self, sweep: Sweep) -> Callable[[], None]:
        """The registration of a sweep, to be called; for the instants see `lidarslam.compare.peers.libraries`."""
        self._instants.append(sweep.end if len(self._instants) >= 2 else sweep.middle)

        def register() -> None:
            self._kiss.register_frame(sweep.scan.points, sweep.scan.time_offsets)
            self._poses.append(self._kiss.last_pose.copy())

        return register

    def finish(self) -> Poses:
        """The poses at the ends of the sweeps."""
        return Poses(np.array(self._instants), np.array(self._poses))


_KISS_ICP = Peer("kiss-icp", "kiss_icp", "kiss-icp", lambda *_: KissIcpEstimator())


class FedPeer:
    """A peer in a separate process."""

    def __init__(self, context: SpawnContext, name: str, every: int, log: Path) -> None:
        self.name = name
        self._end, other = context.Pipe()
        self._process = context.Process(target=_estimate, args=(other, name, every, log), daemon=True)
        self._process.start()
        other.close()

    def take(self, scan: Scan) -> None:
        """Send the next scan, unless the process has ended."""
        try:
            self._end.send(scan)
        except OSError:
            self._end.close()

    def result(self) -> Trajectory | None:
        """The peer's trajectory; None if it failed, with the error in its log."""
        try:
            self._end.send(_END)
            trajectory: Trajectory = self._end.recv()
        except (OSError, EOFError):
            return None
        return trajectory


def feed_peers(scans: Iterator[Scan], peers: list[FedPeer]) -> Iterator[Scan]:
    """The scans, each sent to all peers first, at the speed of the slowest."""
    for scan in scans:
        for peer in peers:
            peer.take(scan)
        yield scan


def _estimate(source: Connection, name: str, every: int, log: Path) -> None:
    """Process of a peer."""
    started = time.process_time()

    def progress(number: int) -> None:
        nonlocal started
        if number % every == 0:
            cpu_ms = 1e3 * (time.process_time() - started) / every
            add_line(log, {"scans": number, "cpu_ms": cpu_ms, "rss_mb": resident_mb()})
            started = time.process_time()

    peer = _KISS_ICP if name == _KISS_ICP.name else PEERS[name]
    try:
        estimated = estimate(peer, iter(source.recv, _END), progress=progress)
    except LidarSlamError as error:
        add_line(log, {"error": str(error)})
        return
    source.send(estimated.trajectory)


def add_line(path: Path, values: Mapping[str, object]) -> None:
    """Append a line of JSON."""
    with path.open("a", encoding="utf-8") as file:
        file.write(f"{json.dumps(values)}\n")


@dataclass(frozen=True)
class Row:
    """State after a number of scans; times are of the scans since the previous row."""

    scans: int
    way_km: float
    median_ms: float
    p99_ms: float
    keyframe_median_ms: float
    keyframe_p99_ms: float
    cpu_ms: float
    rss_mb: float
    state_mb: float
    save_s: float
    submaps_mb: float
    tiles_mb: float
    cells: int
    voxels: int
    keyframes: int
    loops: int
    error_m: float

    def cells_of_table(self) -> list[str]:
        return [f"{value:,}" if isinstance(value, int) else f"{value:,.1f}" for value in asdict(self).values()]


class TimedCheckpoints(Checkpoints):
    """Checkpoints with the time of the last one."""

    save_s = 0.0

    def save(self, pipeline: Pipeline) -> None:
        started = time.perf_counter()
        super().save(pipeline)
        self.save_s = time.perf_counter() - started


def simulate(options: argparse.Namespace, sink: Connection) -> None:
    """The simulator's process: sends the ground truth, then the scans."""
    simulation = make_simulation("town", "car-fast", "vlp-16", options.scans, 0)
    sensor = simulation.sensor
    if options.columns and isinstance(sensor.pattern, Spinning):
        sensor = replace(sensor, pattern=replace(sensor.pattern, columns=options.columns))
        simulation = replace(simulation, sensor=sensor)
    sink.send(simulation.ground_truth)
    with suppress(BrokenPipeError):  # the drive was ended
        for scan in simulation.scans():
            sink.send(scan)
    sink.close()


def received(source: Connection, count: int, stop: Path) -> Iterator[Scan]:
    """`count` scans from the simulator, or fewer once the file `stop` exists."""
    for number in range(count):
        if number % 100 == 0 and stop.exists():
            return
        yield source.recv()


def run(options: argparse.Namespace, scans: Iterator[Scan], truth: Trajectory) -> dict[str, Any]:
    """Our pipeline over all scans, with rows in between; returns the final results."""
    config = Config(
        odometry=OdometryConfig(method=options.odometry),
        global_map=GlobalMapConfig(most_points=_MOST_POINTS),
        pose_graph=PoseGraphConfig(enabled=True),
    )
    localiser = make_localiser(config)
    mapper = localiser.mapper
    assert mapper is not None
    with ExitStack() as stack:
        directory = stack.enter_context(RunDirectory.create(Path(stack.enter_context(TemporaryDirectory()))))
        unfinished = stack.enter_context(Unfinished.claim(directory, {}, resume=False))
        graph = begin_graph(config, file=unfinished.run / SUBMAPS)
        assert graph is not None
        stack.callback(graph.close)
        log, odometry = ScanLog(), open_odometry(config, None)
        stack.callback(odometry.close)
        checkpoints = TimedCheckpoints(unfinished, config.checkpoints, odometry, log, graph)
        store = TileStore(options.out, unfinished.run / TILES)
        pipeline = Pipeline(odometry, localiser, config.global_map, graph, checkpoints, store)
        scans = checkpoints.begin(pipeline, scans, is_recorded=False)
        for row in _rows(options.every, scans, truth, pipeline, mapper, log, graph, checkpoints, unfinished):
            print_row(row.cells_of_table())
            add_line(options.out / "rows.jsonl", asdict(row))
        return _finish(graph, log, pipeline, truth)


def _rows(
    every: int,
    scans: Iterator[Scan],
    truth: Trajectory,
    pipeline: Pipeline,
    mapper: Mapper,
    log: ScanLog,
    graph: SlamGraph,
    checkpoints: TimedCheckpoints,
    unfinished: Unfinished,
) -> Iterator[Row]:
    lengths_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth.positions, axis=0), axis=1))])
    T_first_world = inverse(truth.T_world_lidar[0])
    ms: list[float] = []
    keyframes, cpu = 0, time.process_time()
    for number, result in enumerate(pipeline.run(prefetch(scans)), 1):
        log.add(result)
        ms.append(sum(value for stage, value in result.stage_ms.items() if stage != "read"))
        if number % every:
            continue
        keyframe_ms = graph.keyframe_ms[keyframes:] or [np.nan]
        true_position = (T_first_world @ truth.T_world_lidar[number - 1])[:3, 3]
        row = Row(
            scans=number,
            way_km=float(lengths_m[number - 1]) / 1e3,
            median_ms=float(np.median(ms)),
            p99_ms=float(np.percentile(ms, 99.0)),
            keyframe_median_ms=float(np.median(keyframe_ms)),
            keyframe_p99_ms=float(np.percentile(keyframe_ms, 99.0)),
            cpu_ms=1e3 * (time.process_time() - cpu) / every,
            rss_mb=resident_mb(),
            state_mb=_size_mb(unfinished.run / STATE),
            save_s=checkpoints.save_s,
            submaps_mb=_size_mb(unfinished.run / SUBMAPS),
            tiles_mb=_size_mb(unfinished.run / TILES),
            cells=0 if mapper.local_map is None else len(mapper.local_map),
            voxels=0 if pipeline.map.global_map is None else len(pipeline.map.global_map._merged),
            keyframes=len(graph.keyframe_ms),
            loops=sum(closure.accepted for closure in list(graph._closures)),
            error_m=float(np.linalg.norm(true_position - result.T_world_lidar[:3, 3])),
        )
        yield row
        ms, keyframes, cpu = [], len(graph.keyframe_ms), time.process_time()


def _size_mb(file: Path) -> float:
    return file.stat().st_size / 2**20 if file.exists() else 0.0


def _finish(graph: SlamGraph, log: ScanLog, pipeline: Pipeline, truth: Trajectory) -> dict[str, Any]:
    """Optimise, rebuild the map, and evaluate the trajectory before and after."""
    stamps, before = log.stamps, log.trajectory
    started = time.perf_counter()
    result = graph.finish()
    optimise_s = time.perf_counter() - started
    assert result is not None
    assert pipeline.map.voxel_size_m is not None
    drawn = graph.draw_map(result, pipeline.map.voxel_size_m, most=_MOST_POINTS)
    draw_s = time.perf_counter() - started - optimise_s
    return {
        "optimise_s": optimise_s,
        "draw_s": draw_s,
        "map_points": sum(len(drawn.tile(tile).points()) for tile in drawn.tiles()),
        "loops": sum(result.inliers),
        "redraws": len(graph.redraws),
        "rss_mb": resident_mb(),
        "methods": {
            "before the graph": errors(before, truth),
            "after the graph": errors(Trajectory(stamps, result.T_world_lidar), truth),
        },
    }


def errors(estimate: Trajectory, truth: Trajectory) -> dict[str, float | None]:
    """ATE and KITTI drift."""
    found: TrajectoryMetrics = evaluate_trajectory(estimate, truth)
    drift = None if found.kitti is None else found.kitti.overall
    return {
        "ate_m": found.errors.ate_rmse_m,
        "drift_percent": None if drift is None else drift.translation_percent,
        "drift_deg_per_100m": None if drift is None else 100.0 * drift.rotation_deg_per_m,
    }


def report(found: dict[str, Any], peers: list[FedPeer], truth: Trajectory) -> dict[str, Any]:
    """Print the final results of ours and of the peers."""
    print(
        f"\nfinal optimisation {found['optimise_s']:.1f} s ({found['loops']} loops kept), map rebuilt in"
        f" {found['draw_s']:.1f} s ({found['map_points']:,} points), {found['rss_mb']:.0f} MB; local map rebuilt"
        f" {found['redraws']} times\n"
    )
    for peer in peers:
        estimate = peer.result()
        if estimate is not None:
            found["methods"][peer.name] = errors(estimate, truth)
    print_header(["method", "ATE, m", "drift over 100 to 800 m, %", "degrees per 100 m"])
    for name, measured in found["methods"].items():
        print_row([name, *("" if value is None else f"{value:.3f}" for value in measured.values())])
    return found


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of the results")
    parser.add_argument("--columns", type=int, help="columns per revolution, to use fewer")
    parser.add_argument("--scans", type=int, default=20_000)
    parser.add_argument("--every", type=int, default=1_000)
    parser.add_argument("--odometry", default="constant-velocity", help="odometry method")
    parser.add_argument("--peers", nargs="*", default=["kiss-icp", "kiss-slam"])
    options = parser.parse_args()
    logging.disable(logging.INFO)
    options.out.mkdir(parents=True)
    context = multiprocessing.get_context("spawn")
    source, sink = context.Pipe(duplex=False)
    simulator = context.Process(target=simulate, args=(options, sink), daemon=True)
    simulator.start()
    truth = source.recv()
    print_header(_HEADER)
    peers = [FedPeer(context, name, options.every, options.out / f"{name}.jsonl") for name in options.peers]
    found = run(options, feed_peers(received(source, options.scans, options.out / "stop"), peers), truth)
    found = report(found, peers, truth)
    (options.out / "end.json").write_text(json.dumps(found, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
