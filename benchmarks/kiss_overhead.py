"""Overhead of `lidarslam run --odometry kiss-icp --no-mapping` over KISS-ICP, in accuracy and time.

    python benchmarks/kiss_overhead.py KITTI/sequences/04 2011_09_26/2011_09_26_drive_0005_sync

The programs alternate, each in a separate process, on the same files. KISS-ICP is its own pipeline with its defaults,
reading the files as its KITTI loaders do. Time is the wall time of the loop over the scans, including reading; ours
also checks every scan, builds the global map and writes scans.csv. The time after the loop (normals, files) is given
separately. KISS-ICP's poses refer to the end of each sweep; they are interpolated at the scans' stamps, to which ours
refer, so that both are evaluated at the same instants.
"""

import functools
import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mapping_accuracy import in_process, make_parser

from lidarslam.core.geometry import FloatArray
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.registry import open_recording
from lidarslam.evaluation.trajectory.metrics import evaluate_trajectory


class _KittiFiles:
    """The scans of a KITTI recording for KISS-ICP's pipeline, read and corrected as by its loaders."""

    def __init__(self, source: Path, has_times: bool) -> None:
        folder = source / "velodyne_points" / "data"
        self._files = sorted((folder if folder.is_dir() else source / "velodyne").glob("*.bin"))
        self._has_times = has_times
        self.sequence_id = source.name

    def __len__(self) -> int:
        return len(self._files)

    def __getitem__(self, index: int) -> tuple[FloatArray, FloatArray]:
        from kiss_icp.pybind import kiss_icp_pybind as pybind

        raw = np.fromfile(self._files[index], dtype=np.float32).reshape(-1, 4)[:, :3].astype(np.float64)
        points = np.asarray(pybind._correct_kitti_scan(pybind._Vector3dVector(raw)))
        if not self._has_times:
            return points, np.array([])
        return points, 0.5 * (1.0 - np.arctan2(points[:, 1], points[:, 0]) / np.pi)


@dataclass(frozen=True, eq=False)
class Ran:
    """A program's run on a recording."""

    trajectory: Trajectory
    ms_per_scan: float
    after_s: float  # after the loop over the scans


def run_kiss(source: Path) -> Ran:
    """Run KISS-ICP's own pipeline."""
    from kiss_icp.pipeline import OdometryPipeline

    recording = open_recording(source)
    scans = list(recording.scans())
    stamps = np.array([scan.stamp for scan in scans])
    ends = np.array([s.stamp if s.time_offsets is None else s.stamp + s.time_offsets.max() for s in scans])
    del scans
    with tempfile.TemporaryDirectory() as folder:
        os.environ |= {"kiss_icp_out_dir": folder}
        pipeline = OdometryPipeline(_KittiFiles(source, has_times=bool((ends > stamps).all())))
        started = time.perf_counter()
        pipeline._run_pipeline()
        elapsed_s = time.perf_counter() - started
    within = stamps >= ends[0]
    at_stamps = Trajectory(stamps[within], Trajectory(ends, pipeline.poses).at(stamps[within]))
    return Ran(at_stamps, 1e3 * elapsed_s / len(ends), 0.0)


def run_ours(source: Path) -> Ran:
    """Run `lidarslam run`."""
    from lidarslam.config.settings import load_config
    from lidarslam.core.trajectory import read_tum
    from lidarslam.run.request import RunRequest
    from lidarslam.run.run import execute

    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        config = load_config(None, ["odometry.method=kiss-icp", "mapping.method=off"])
        outcome = execute(RunRequest(source, Path(folder) / "run", config), lambda *_: None)
        whole_s = time.perf_counter() - started
        trajectory = read_tum(Path(folder) / "run" / "trajectory.tum")
    loop_s = outcome.summary.elapsed_s
    return Ran(trajectory, 1e3 * loop_s / len(trajectory), whole_s - loop_s)


def ate_m(trajectories: list[Trajectory], reference: Trajectory) -> list[float]:
    """ATE of each trajectory over the scans common to all."""
    common = functools.reduce(np.intersect1d, [trajectory.stamps.round(6) for trajectory in trajectories])
    chosen = [t.select(np.isin(t.stamps.round(6), common)) for t in trajectories]
    return [evaluate_trajectory(trajectory, reference).errors.ate_rmse_m for trajectory in chosen]


def compare(source: Path, rounds: int) -> None:
    """Run both alternately and print a table."""
    kiss, ours = list[Ran](), list[Ran]()
    for _ in range(rounds):
        kiss.append(in_process(run_kiss, source))
        ours.append(in_process(run_ours, source))
    reference = open_recording(source).ground_truth
    last = [kiss[-1].trajectory, ours[-1].trajectory]
    ates = [float("nan")] * 2 if reference is None else ate_m(last, reference)
    print(f"\n{source.name}: {rounds} rounds, median [min, max]")
    for name, results, ate in zip(("KISS-ICP's pipeline", "lidarslam run"), (kiss, ours), ates, strict=True):
        ms = [result.ms_per_scan for result in results]
        after_s = np.median([result.after_s for result in results])
        print(
            f"  {name:<20} ATE {ate:.4f} m   {np.median(ms):6.1f} [{min(ms):.1f}, {max(ms):.1f}] ms per scan"
            f"   {after_s:4.1f} s after the loop"
        )
    ratios = [one.ms_per_scan / other.ms_per_scan for one, other in zip(ours, kiss, strict=True)]
    print(
        f"  ATE differs by {1e3 * (ates[1] - ates[0]):+.2f} mm; time per scan is"
        f" {np.median(ratios):.2f} [{min(ratios):.2f}, {max(ratios):.2f}] times KISS-ICP's"
    )


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("sources", nargs="+", type=Path, help="KITTI sequences/NN folders or raw drive folders")
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    for source in arguments.sources:
        compare(source, arguments.rounds)


if __name__ == "__main__":
    main()
