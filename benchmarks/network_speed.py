"""How long the networks take for a pair of scans, beside one another in one run, and how the rest of a scan compares.

    python benchmarks/network_speed.py --threads 2

Prints a table with the processor time and the wall time of each network for a pair of images of the same size, the
median over `--repeats`. Encodings are kept from pair to pair in the program, so `correlation` is timed as it is used:
one scan encoded, one pair compared. Then the same for the other stages of the learned odometry on a simulated scan.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from statistics import median
from typing import Literal

import numpy as np
import torch
from mapping_accuracy import simulate

from odometry.alignment import Guess, align
from odometry.image_config import ImageConfig
from odometry.learned_config import LearnedConfig
from odometry.network_config import CorrelationConfig, NetworkConfig, NetworkName
from odometry.networks import make_network
from odometry.sweep_images import Imager
from odometry.sweeps import SweepPair

Change = Literal["", "channels last", "bfloat16"]
_VARIANTS: tuple[tuple[str, NetworkName, Change], ...] = (
    ("delora", "delora", ""),
    ("correlation", "correlation", ""),
    ("correlation, channels last", "correlation", "channels last"),
    ("correlation, bfloat16", "correlation", "bfloat16"),
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=16)
    parser.add_argument("--columns", type=int, default=720)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--sensor", default="vlp-16")
    options = parser.parse_args(arguments)
    torch.set_num_threads(options.threads)
    size = f"{options.rows} x {options.columns}"
    print(f"A pair of {size} images, {options.threads} threads\n")
    print("| network | parameters | wall, ms | CPU, ms | times faster |\n| --- | --- | --- | --- | --- |")
    slowest = None
    for label, name, change in _VARIANTS:
        network = make_network(NetworkConfig(name=name, correlation=CorrelationConfig(rows=options.rows)))
        count = sum(p.numel() for p in network.parameters())
        wall, cpu = time_pair(network, options.rows, options.columns, options.repeats, change)
        slowest = slowest or wall
        print(f"| {label} | {count:,} | {wall:.1f} | {cpu:.1f} | {slowest / wall:.1f} |", flush=True)
    print(f"\nStages of the learned odometry, {options.sensor} in an office\n")
    print("| stage | wall, ms | CPU, ms |\n| --- | --- | --- |")
    for label, stage in _stages(options).items():
        wall, cpu = _timed(stage, options.repeats)
        print(f"| {label} | {wall:.1f} | {cpu:.1f} |", flush=True)


def time_pair(
    network: torch.nn.Module, rows: int, columns: int, repeats: int, change: Change = ""
) -> tuple[float, float]:
    """Median wall and processor milliseconds of one scan encoded and one pair compared."""
    network = network.eval()
    points = torch.randn(1, 3, rows, columns) * 10.0
    normals = torch.nn.functional.normalize(torch.randn_like(points), dim=1)
    if change == "channels last":
        network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        points, normals = (x.contiguous(memory_format=torch.channels_last) for x in (points, normals))
    with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=change == "bfloat16"):
        earlier = network.encode(points, normals)  # type: ignore[operator]
        return _timed(lambda: network(earlier, network.encode(points, normals)), repeats)  # type: ignore[operator]


def _stages(options: argparse.Namespace) -> dict[str, Callable[[], object]]:
    scans = simulate("office", "handheld", options.sensor, 12, 0).scans[-2:]
    imager = Imager(ImageConfig(rows=options.rows, columns=options.columns))
    previous, current = (imager.images(scan).alignment for scan in scans)
    sweeps, config = SweepPair(current, previous, 0.1), LearnedConfig().alignment
    return {
        "images and normals": lambda: imager.images(scans[1]),
        "alignment": lambda: align(Guess(np.eye(4)), sweeps, config),
    }


@torch.inference_mode()
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
