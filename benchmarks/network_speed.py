"""How long the learned odometry takes for a scan, stage by stage, beside DeLORA's network in the same run.

    python benchmarks/network_speed.py --threads 1 --sensors vlp-16 hdl-64e

Prints a table of networks, a pair of images of 16 x 720 each, and one of the stages of a scan of each sensor: medians
over `--repeats`, wall time and processor time. A network is timed as it is used: what is kept of the scan before is not
computed again. Scans are simulated, a car in a street.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from statistics import median

import numpy as np
import torch
from mapping_accuracy import simulate

from lidarslam.core.scan import Scan
from lidarslam.odometry.alignment.alignment import InitialEstimate, align
from lidarslam.odometry.alignment.sweep_motion import SweepPair
from lidarslam.odometry.config import ImageConfig, LearnedConfig, NetworkConfig, OdometryConfig
from lidarslam.odometry.images.sweep_images import Imager, SweepImages
from lidarslam.odometry.network.candidates import Described, Search
from lidarslam.odometry.network.checkpoint import load_checkpoint, network_of
from lidarslam.odometry.network.exported import onnx_search, read_exported
from lidarslam.odometry.network.networks import make_network
from lidarslam.odometry.network.shipped import default_weights, shipped_folder
from lidarslam.odometry.network.torch_graphs import torch_search
from lidarslam.odometry.registry import make_odometry

SCANS = 12


def main(arguments: Sequence[str] | None = None) -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--sensors", nargs="+", default=["vlp-16", "hdl-64e"])
    options = parser.parse_args(arguments)
    torch.set_num_threads(options.threads)
    recordings = {sensor: simulate("street", "car", sensor, SCANS, 0).scans for sensor in options.sensors}
    imager = Imager(ImageConfig())
    pair = [imager.images(scan).network for scan in recordings[options.sensors[0]][-2:]]
    print(f"A pair of 16 x 720 images, threads: {options.threads}\n")
    print("| network | parameters | wall, ms | CPU, ms | times faster |\n| --- | --- | --- | --- | --- |")
    slowest = None
    for label, search, parameters in _networks(options.threads):
        before = search.describe(pair[0].points, pair[0].normals)
        wall, cpu = _timed(_comparison(search, before, pair[1]), options.repeats)
        slowest = slowest or wall
        print(f"| {label} | {parameters:,} | {wall:.1f} | {cpu:.1f} | {slowest / wall:.1f} |", flush=True)
    for sensor, scans in recordings.items():
        print(f"\nA scan of {sensor}\n\n| stage | wall, ms | CPU, ms |\n| --- | --- | --- |")
        for label, stage in _stages(scans, options.threads).items():
            wall, cpu = _timed(stage, options.repeats)
            print(f"| {label} | {wall:.1f} | {cpu:.1f} |", flush=True)


def _networks(threads: int) -> list[tuple[str, Search, int]]:
    """DeLORA's with its first weights, which takes as long as with trained ones, and the shipped one in two ways."""
    delora = make_network(NetworkConfig(name="delora")).eval()
    shipped = network_of(load_checkpoint(default_weights()))
    sizes = [sum(p.numel() for p in network.parameters()) for network in (delora, shipped)]
    return [
        ("delora, torch", torch_search(delora, threads=threads), sizes[0]),
        ("correlation, torch", torch_search(shipped, threads=threads), sizes[1]),
        ("correlation, ONNX Runtime", onnx_search(read_exported(shipped_folder()), threads), sizes[1]),
    ]


def _comparison(search: Search, before: Described, images: SweepImages) -> Callable[[], object]:
    return lambda: search.compare(before, images.points, images.normals)


def _stages(scans: Sequence[Scan], threads: int) -> dict[str, Callable[[], object]]:
    imager, search = Imager(ImageConfig()), onnx_search(read_exported(shipped_folder()), threads)
    previous, current = (imager.images(scan) for scan in scans[-2:])
    before = search.describe(previous.network.points, previous.network.normals)
    candidates, _ = search.compare(before, current.network.points, current.network.normals)
    information = np.asarray(np.linalg.inv(candidates[0].covariance), dtype=np.float64)
    start = InitialEstimate(candidates[0].T_prev_curr, information)
    sweeps = SweepPair(current.alignment, previous.alignment, scans[-1].stamp - scans[-2].stamp)
    return {
        "images and normals": lambda: imager.images(scans[-1]),
        "network": _comparison(search, before, current.network),
        "alignment": lambda: align(start, sweeps),
        "all of the odometry": _whole(scans, threads),
    }


def _whole(scans: Sequence[Scan], threads: int) -> Callable[[], object]:
    """The next scan of the recording, over and over; the jump from its end to its beginning is not timed apart."""
    odometry = make_odometry(OdometryConfig(method="learned", learned=LearnedConfig(threads=threads)))
    state = {"next": 0}

    def step() -> None:
        odometry.estimate(scans[state["next"] % len(scans)])
        state["next"] += 1

    return step


def _timed(work: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Median wall and processor milliseconds, after two rounds that do not count."""
    walls, cpus = [], []
    for _ in range(repeats + 2):
        wall, cpu = time.perf_counter(), time.process_time()
        work()
        walls.append(1e3 * (time.perf_counter() - wall))
        cpus.append(1e3 * (time.process_time() - cpu))
    return median(walls[2:]), median(cpus[2:])


if __name__ == "__main__":
    main()
