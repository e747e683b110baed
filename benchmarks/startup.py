"""Time from the command to the first scan's result: first run on a machine, later runs, and KISS-ICP.

    python benchmarks/startup.py KITTI --sequence 04
    python benchmarks/startup.py office.mcap --runs 5

Each program runs in separate processes, on two scans; times are wall times from the start of the process, the median of
the later runs. `first run` has an empty folder for compiled code. KISS-ICP is its own pipeline with the loader that it
chooses for the source. The first process of each program does not count: it reads the libraries from disk.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

BEGUN = "LIDARSLAM_BENCHMARK_BEGUN"


def run_ours(source: Path, sequence: str | None) -> None:
    """`lidarslam run`, with the time of the first scan."""
    from lidarslam.cli import main
    from lidarslam.run import progress

    seen: list[tuple[float, float]] = []
    show = progress.RunProgress.__call__

    def note(*arguments: object) -> None:
        seen.append(_now())
        show(*arguments)  # type: ignore[arg-type]

    progress.RunProgress.__call__ = note  # type: ignore[method-assign,assignment]
    chosen = [] if sequence is None else ["--sequence", sequence]
    with tempfile.TemporaryDirectory() as folder:
        command = ["run", str(source), *chosen, "--stop", "2", "--out", str(Path(folder) / "run")]
        main(command, standalone_mode=False)
        _report(*seen)


def run_kiss(source: Path, sequence: str | None) -> None:
    """KISS-ICP's pipeline on the first scan, then on one more."""
    from kiss_icp.datasets import dataset_factory
    from kiss_icp.pipeline import OdometryPipeline
    from kiss_icp.tools.cmd import guess_dataloader

    loader, folder = (
        ("kitti", source) if sequence is not None else guess_dataloader(source, default_dataloader="generic")
    )
    more = {} if sequence is None else {"sequence": sequence}
    dataset = dataset_factory(dataloader=loader, data_dir=Path(folder), **more)
    pipeline, seen = OdometryPipeline(dataset, n_scans=2), list[tuple[float, float]]()
    register = pipeline.odometry.register_frame

    def registered(*arguments: object) -> object:
        result = register(*arguments)
        seen.append(_now())
        return result

    pipeline.odometry.register_frame = registered
    pipeline._run_pipeline()
    _report(*seen)


def _now() -> tuple[float, float]:
    """Wall seconds since the process began, and CPU seconds."""
    times = os.times()
    cpu_s = times.user + times.system + times.children_user + times.children_system
    return time.time() - float(os.environ[BEGUN]), cpu_s


def _report(first: tuple[float, float], *_: tuple[float, float]) -> None:
    print(json.dumps([*first, *_now()]))


def measure(program: str, source: Path, sequence: str | None, compiled: str) -> list[float]:
    """Wall and CPU seconds of a separate process, to the first scan and to the end of two."""
    chosen = [] if sequence is None else ["--sequence", sequence]
    command = [sys.executable, __file__, str(source), *chosen, "--only", program]
    environment = os.environ | {"NUMBA_CACHE_DIR": compiled, BEGUN: repr(time.time())}
    done = subprocess.run(
        command, check=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment
    )
    values: list[float] = json.loads(done.stdout.splitlines()[-1])
    return values


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path)
    parser.add_argument("--sequence")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--only", choices=["ours", "kiss-icp"], help=argparse.SUPPRESS)
    options = parser.parse_args()
    chosen = options.source.resolve(), options.sequence
    if options.only is not None:
        (run_ours if options.only == "ours" else run_kiss)(*chosen)
        return
    print("| program | first scan, s | processor time, s | two scans, s | processor time, s |")
    print("|---|---:|---:|---:|---:|")
    with tempfile.TemporaryDirectory() as warm, tempfile.TemporaryDirectory() as empty:
        measure("ours", *chosen, warm)
        _print("lidarslam run, first run", [measure("ours", *chosen, empty)])
        _print("lidarslam run", [measure("ours", *chosen, warm) for _ in range(options.runs)])
        measure("kiss-icp", *chosen, warm)
        _print("KISS-ICP", [measure("kiss-icp", *chosen, warm) for _ in range(options.runs)])


def _print(name: str, runs: list[list[float]]) -> None:
    medians = [statistics.median(values) for values in zip(*runs, strict=True)]
    print(f"| {name} | " + " | ".join(f"{value:.1f}" for value in medians) + " |", flush=True)


if __name__ == "__main__":
    main()
