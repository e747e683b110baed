"""A robot's loop: scans arrive at a fixed rate, and `register_frame` has to keep up; compared with KISS-ICP.

    python benchmarks/python_loop.py RECORDING [--set odometry.method=constant-velocity] [--rate 10] [--scans 200]

Methods run one after the other, each in a separate process, over scans in memory. Printed are the time of a call; the
time from the arrival of a scan to its pose (`late`, which includes waiting for the previous scan); overruns (poses
later than the next scan); ATE of the poses as returned; memory in the middle and at the end. KISS-ICP's poses refer to
the end of a sweep and are compared there.
"""

import argparse
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import psutil

import lidarslam
from lidarslam.core.geometry import FloatArray, inverse

Register = Callable[[lidarslam.Scan], FloatArray]
_WARM_UP = 3


@dataclass(frozen=True, eq=False)
class Paced:
    """Result of one method; arrays have one entry per scan."""

    call_ms: FloatArray  # (N,) wall time of each call
    answer_ms: FloatArray  # (N,) from the arrival of a scan to its pose
    stamps: FloatArray  # (N,) of the poses
    T_world_lidar: FloatArray  # (N, 4, 4) as returned
    memory_mb: tuple[float, float]  # in the middle and at the end


Method = Callable[[list[lidarslam.Scan], float], Paced]


def pace(register: Register, scans: list[lidarslam.Scan], period_s: float) -> Paced:
    """Register each scan when it is due, or as soon as the previous one is done."""
    memory, process = [0.0, 0.0], psutil.Process()
    call_ms, answer_ms, poses = [], [], []
    begin = time.perf_counter() + period_s
    for number, scan in enumerate(scans):
        due = begin + number * period_s
        time.sleep(max(0.0, due - time.perf_counter()))
        started = time.perf_counter()
        poses.append(register(scan))
        done = time.perf_counter()
        call_ms.append(1e3 * (done - started))
        answer_ms.append(1e3 * (done - due))
        if number in (len(scans) // 2, len(scans) - 1):
            memory[number == len(scans) - 1] = process.memory_info().rss / 2**20
    stamps = np.array([scan.stamp for scan in scans])
    return Paced(np.array(call_ms), np.array(answer_ms), stamps, np.array(poses), (memory[0], memory[1]))


def run_slam(scans: list[lidarslam.Scan], period_s: float, settings: dict[str, str]) -> Paced:
    """Run lidarslam with these settings."""
    with lidarslam.Slam(settings) as warm:
        for scan in scans[:_WARM_UP]:
            warm.register_frame(scan)
    with lidarslam.Slam(settings) as slam:
        return pace(
            lambda scan: slam.register_frame(scan.points, scan.time_offsets, scan.stamp).T_world_lidar, scans, period_s
        )


def run_kiss_icp(scans: list[lidarslam.Scan], period_s: float) -> Paced:
    """Run KISS-ICP with its defaults."""
    from kiss_icp.config.parser import load_config
    from kiss_icp.kiss_icp import KissICP

    def make() -> Register:
        kiss = KissICP(load_config(None))

        def register(scan: lidarslam.Scan) -> FloatArray:
            kiss.register_frame(scan.points, np.empty(0) if scan.time_offsets is None else scan.time_offsets)
            return np.array(kiss.last_pose)

        return register

    warm = make()
    for scan in scans[:_WARM_UP]:
        warm(scan)
    paced = pace(make(), scans, period_s)
    ends = np.array([0.0 if scan.time_offsets is None else scan.time_offsets.max() for scan in scans])
    return Paced(paced.call_ms, paced.answer_ms, paced.stamps + ends, paced.T_world_lidar, paced.memory_mb)


def describe(paced: Paced, truth: lidarslam.Trajectory | None, period_s: float) -> str:
    overruns = int((paced.answer_ms > 1e3 * period_s).sum())
    poses = lidarslam.Trajectory(paced.stamps, inverse(paced.T_world_lidar[0]) @ paced.T_world_lidar)
    error = "-"
    if truth is not None:
        error = f"{lidarslam.evaluate(poses, truth)['trajectory']['ate_rmse_m']:.3f}"
    late = np.percentile(paced.answer_ms, 99)
    return (
        f"{np.median(paced.call_ms):10.1f}{np.percentile(paced.call_ms, 99):8.1f}{late:9.1f}"
        f"{overruns:7d}/{len(poses)}{error:>9}{paced.memory_mb[0]:8.0f}{paced.memory_mb[1]:6.0f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--sequence")
    parser.add_argument("--rate", type=float, default=10.0, help="scans per second")
    parser.add_argument("--scans", type=int, help="number of scans")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="settings of lidarslam")
    given = parser.parse_args()
    recording = lidarslam.open(given.recording, sequence=given.sequence, stop=given.scans)
    scans, period_s = list(recording), 1.0 / given.rate
    settings = dict(setting.split("=", 1) for setting in given.set)
    print(f"{len(scans)} scans of {recording.name} at {given.rate:g} Hz")
    print("            median   p99 ms  p99 late  overruns    ATE m   MB: half  end")
    methods: dict[str, Method] = {"lidarslam": partial(run_slam, settings=settings), "kiss-icp": run_kiss_icp}
    for name, run in methods.items():
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            paced = pool.submit(run, scans, period_s).result()
        print(f"{name:10}{describe(paced, recording.ground_truth, period_s)}", flush=True)


if __name__ == "__main__":
    main()
