"""Time of the learned odometry by stage, and of its network compared with DeLORA's.

    python benchmarks/network_speed.py --threads 1 --sensors vlp-16 hdl-64e
    python benchmarks/network_speed.py --recordings KITTI/sequences/04 vlp16_loop --sensors os1-128 --scans 50

Prints a table of networks, for a pair of images of 16 x 720 each: medians of 30 repeats, wall time and CPU time.
Networks are timed as used: results kept from the previous scan are not computed again. Then a table of stages with a
column per recording: CPU milliseconds of the odometry's thread, without the stages inside, over the first `--scans`
scans. Of five passes, the shortest time of every scan and stage is used, because other load only adds to it, then the
mean over all scans. The recordings of the sensors are simulated, with a car in a street.
"""

import itertools
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from statistics import mean, median
from typing import Any
from unittest.mock import patch

import torch
from mapping_accuracy import make_parser, simulate
from mapping_speed import Stopwatch

from lidarslam.core.scan import Scan
from lidarslam.datasets.registry import open_recording
from lidarslam.odometry.alignment import alignment
from lidarslam.odometry.alignment.point_to_plane import PointToPlane
from lidarslam.odometry.config import ImageConfig, LearnedConfig, NetworkConfig, OdometryConfig
from lidarslam.odometry.images import sweep_images
from lidarslam.odometry.images.sweep_images import Imager, SweepImages
from lidarslam.odometry.methods import learned
from lidarslam.odometry.network import candidates
from lidarslam.odometry.network.candidates import Described, Search
from lidarslam.odometry.network.checkpoint import load_checkpoint, network_of, torch_search
from lidarslam.odometry.network.exported import load_exported
from lidarslam.odometry.network.networks import make_network
from lidarslam.odometry.registry import default_weights, make_odometry, shipped_folder
from lidarslam.pipeline.threads import in_order

SCANS = 12
# Comparisons of a pair, and passes over a recording.
_REPEATS, _ROUNDS = 30, 5
# The first scan has no pair, and the second no previous motion.
_WARM_UP = 2

_STAGES: dict[str, list[tuple[Any, str]]] = {
    "projection": [(sweep_images, "project")],
    "normals": [(sweep_images, "surface_normals")],
    "images, rest": [(sweep_images.Imager, "images")],
    "graph of columns": [],
    "graph of turns": [],
    "bird's-eye grid": [(candidates, "bird_eye")],
    "graph of the bird's-eye grid": [],
    "graph of peaks": [],
    "network, rest": [(candidates.CorrelationSearch, "compare")],
    "alignment: points and planes": [(alignment, "PointToPlane")],
    "alignment: normal equations": [(PointToPlane, "normal_equations"), (PointToPlane, "fit")],
    "alignment, rest": [(learned, "align_best"), (learned, "align")],
}
_GRAPHS = {
    "columns": "graph of columns",
    "turns": "graph of turns",
    "bird": "graph of the bird's-eye grid",
    "peaks": "graph of peaks",
}


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--sensors", nargs="+", default=["vlp-16", "hdl-64e"], help="simulated")
    parser.add_argument("--recordings", nargs="+", type=Path, default=[])
    parser.add_argument("--scans", type=int, default=SCANS)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    recordings = {sensor: list(simulate("street", "car", sensor, options.scans, 0).scans) for sensor in options.sensors}
    imager = Imager(ImageConfig())
    pair = [imager.images(scan).network for scan in recordings[options.sensors[0]][-2:]]
    print(f"A pair of 16 x 720 images, threads: {options.threads}\n")
    print("| network | parameters | wall, ms | CPU, ms | times faster |\n| --- | --- | --- | --- | --- |")
    slowest = None
    for label, search, parameters in _networks(options.threads):
        before = search.describe(pair[0].points, pair[0].normals)
        wall, cpu = _timed(_comparison(search, before, pair[1]))
        slowest = slowest or wall
        print(f"| {label} | {parameters:,} | {wall:.1f} | {cpu:.1f} | {slowest / wall:.1f} |", flush=True)
    for source in options.recordings:
        recorded = open_recording(source)
        recordings[recorded.name] = list(itertools.islice(in_order(recorded.scans()), options.scans))
    _print_stages(recordings, options.threads)


def _networks(threads: int) -> list[tuple[str, Search, int]]:
    """DeLORA's with initial weights, as fast as with trained ones, and the included one with two runtimes."""
    delora = make_network(NetworkConfig(name="delora")).eval()
    shipped = network_of(load_checkpoint(default_weights()))
    sizes = [sum(p.numel() for p in network.parameters()) for network in (delora, shipped)]
    return [
        ("delora, torch", torch_search(delora, threads=threads), sizes[0]),
        ("correlation, torch", torch_search(shipped, threads=threads), sizes[1]),
        ("correlation, ONNX Runtime", load_exported(shipped_folder(), threads)[0], sizes[1]),
    ]


def _comparison(search: Search, before: Described, images: SweepImages) -> Callable[[], object]:
    return lambda: search.compare(before, images.points, images.normals)


def _print_stages(recordings: dict[str, list[Scan]], threads: int) -> None:
    found = {name: _stage_times(scans, threads) for name, scans in recordings.items()}
    print(f"\n| stage, ms | {' | '.join(recordings)} |\n| --- |{' ---: |' * len(recordings)}")
    for stage in (*_STAGES, "rest"):
        print(f"| {stage} | {' | '.join(f'{times.get(stage, 0.0):.2f}' for times in found.values())} |")
    print(f"| odometry, total | {' | '.join(f'{sum(times.values()):.2f}' for times in found.values())} |")


def _stage_times(scans: Sequence[Scan], threads: int) -> dict[str, float]:
    """Milliseconds per scan of each stage."""
    passes = []
    for _ in range(_ROUNDS):
        odometry = make_odometry(OdometryConfig(method="learned", learned=LearnedConfig(threads=threads)))
        watch = Stopwatch()
        with ExitStack() as stack:
            for stage, places in _STAGES.items():
                for owner, name in places:
                    stack.enter_context(patch.object(owner, name, watch.wrap(stage, getattr(owner, name))))
            search: Any = getattr(odometry, "_search")  # noqa: B009
            graphs = {name: watch.wrap(stage, getattr(search._parts, name)) for name, stage in _GRAPHS.items()}
            search._parts = search._parts._replace(**graphs)
            estimate, each = watch.wrap("rest", odometry.estimate), []
            for scan in scans:
                watch.seconds.clear()
                estimate(scan)
                each.append({stage: 1e3 * spent[2] for stage, spent in watch.seconds.items()})
        passes.append(each[_WARM_UP:])
    stages = {stage for each in passes for one in each for stage in one}
    return {
        stage: mean(min(one.get(stage, 0.0) for one in scan) for scan in zip(*passes, strict=True)) for stage in stages
    }


def _timed(work: Callable[[], object]) -> tuple[float, float]:
    """Median wall and CPU milliseconds, after two rounds that do not count."""
    walls, cpus = [], []
    for _ in range(_REPEATS + 2):
        wall, cpu = time.perf_counter(), time.process_time()
        work()
        walls.append(1e3 * (time.perf_counter() - wall))
        cpus.append(1e3 * (time.process_time() - cpu))
    return median(walls[2:]), median(cpus[2:])


if __name__ == "__main__":
    main()
