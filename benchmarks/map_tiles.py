"""Memory and time of the global map along a growing street, with and without a limit on its voxels in memory.

    python benchmarks/map_tiles.py --most-points 1000000
    python benchmarks/map_tiles.py --most-points none

A synthetic street 80 m wide winds through a square of 1 km; every 0.8 m, a scan is added to the map at the true pose.
Prints a Markdown table with a row every `--every` scans: resident memory, its peak so far, and the size of the file of
tiles, in megabytes; voxels in memory; time per scan, without generating its points. Below it, time and memory of the
final map, written to a temporary folder. Linux only: memory is read from /proc.
"""

import os
import time
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from mapping_accuracy import make_parser, print_header, print_row
from memory import resident_mb

from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.config import GlobalMapConfig
from lidarslam.mapping.global_map.global_map import GlobalMap
from lidarslam.mapping.global_map.moved_points import PlacedViews
from lidarslam.mapping.global_map.voxels import TileStore
from lidarslam.run.results import draw, format_map, write_map
from lidarslam.run.summary import peak_rss_mb
from lidarslam.storage.directory import RunDirectory

_STEP_M, _LEG_M, _APART_M = 0.8, 1000.0, 120.0


def street(number: int, points: int) -> tuple[FloatArray, FloatArray]:
    """Points (N, 3) of a scan in the LiDAR frame, ground and facades on both sides, and its pose (4, 4)."""
    rng = np.random.default_rng(number)
    along, far = rng.exponential(15.0, points) * rng.choice([-1.0, 1.0], points), points // 2
    ground = np.column_stack([along[:far], rng.uniform(-40.0, 40.0, far), np.full(far, -1.8)])
    side = rng.choice([-40.0, 40.0], points - far)
    facades = np.column_stack([along[far:], side, rng.uniform(-1.8, 10.0, points - far)])
    cloud = np.vstack([ground, facades]) + 0.02 * rng.normal(size=(points, 3))
    pose, travelled_m = np.eye(4), number * _STEP_M
    leg, rest = divmod(travelled_m, _LEG_M)
    pose[:3, 3] = rest if leg % 2 == 0 else _LEG_M - rest, leg * _APART_M, 0.0
    return cloud, pose


def watch(built: GlobalMap, store: TileStore, scans: int, points: int, every: int) -> None:
    """Add the scans and print rows."""
    spent = 0.0
    for number in range(1, scans + 1):
        cloud, pose = street(number, points)
        started = time.perf_counter()
        built.add(cloud, pose)
        spent += time.perf_counter() - started
        if number % every == 0:
            started = time.perf_counter()
            voxels = len(built.points())
            spent += time.perf_counter() - started
            figures = (resident_mb(), peak_rss_mb(), store.size_bytes / 2**20, voxels, 1e3 * spent / every)
            print_row([f"{number:,}", *(f"{figure:,.0f}" for figure in figures[:4]), f"{figures[4]:.1f}"])
            spent = 0.0


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--most-points", default="1000000", help="global_map.most_points; none: unlimited")
    parser.add_argument("--scans", type=int, default=6_000)
    parser.add_argument("--points", type=int, default=20_000, help="points per scan")
    parser.add_argument("--every", type=int, default=500)
    arguments = parser.parse_args()
    most = None if arguments.most_points == "none" else int(arguments.most_points)
    config = GlobalMapConfig(voxel_size_m=0.2, most_points=most)
    header = ["scans", "memory, MB", "peak, MB", "file, MB", "voxels in memory", "ms per scan"]
    print_header(header)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(dir=os.environ.get("TMPDIR"))))
        directory = stack.enter_context(RunDirectory.create(folder))
        store = TileStore(folder)
        built = GlobalMap(0.2, most, store)
        watch(built, store, arguments.scans, arguments.points, arguments.every)
        started = time.perf_counter()
        written = write_map(directory, draw(built, PlacedViews.join([]), config, directory))
        spent, size = time.perf_counter() - started, sum(path.stat().st_size for path in folder.rglob("*.*"))
        print(f"\n{format_map(written)}.\nThe final map took {spent:.0f} s, {peak_rss_mb():,.0f} MB at most,", end=" ")
        print(f"and {size / 2**20:,.0f} MB of disk.")


if __name__ == "__main__":
    main()
