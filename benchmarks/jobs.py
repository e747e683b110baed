"""Wall time of a comparison of 12 recordings: one job, two, a Ray cluster of two nodes, and one of them killed.

    python benchmarks/jobs.py
    python benchmarks/jobs.py --recordings 4 --scans 20 --methods constant-velocity+map,learned+map

The recordings are simulated. The cluster's nodes are on this machine, with one CPU each; the killed one dies with all
its processes when a third of the runs have been started. `run again` are runs that were started more than once;
`equal` says whether the files of the comparison's folder are those of one job, but for times and memory.
"""

import argparse
import json
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

from lidarslam.compare.comparison import Narrator, compare
from lidarslam.compare.methods.names import parse_methods
from lidarslam.compare.request import CompareRequest, RecordingEntry
from lidarslam.core.tasks.tasks import Where
from lidarslam.simulation.recording.record import record
from lidarslam.simulation.recording.request import RecordRequest

WORLDS = ("office", "street", "hall", "tunnel")
SAME = ("config.yaml", "map.ply", "odometry.tum", "trajectory.tum", "trajectory.kitti")
TIMES = ("ms_per_scan_median", "ms_per_scan_p95", "stage_ms", "peak_rss_mb", "wall_s")

# Notes the start of a method, and becomes its process.
NOTED = """
import json, os, sys
from pathlib import Path
out = Path(json.loads(sys.argv[-1])["out"])
with open(sys.argv[1], "a") as file: file.write(f"{out.parent.name}/{out.name}\\n")
os.execv(sys.executable, [sys.executable, "-m", "lidarslam.compare.methods.process", *sys.argv[2:]])
"""


def make_recordings(folder: Path, count: int, scans: int) -> tuple[RecordingEntry, ...]:
    """Short walks through worlds of different seeds."""
    entries = []
    for number in range(count):
        world, seed = WORLDS[number % len(WORLDS)], number // len(WORLDS)
        out = folder / f"{world}_{seed}"
        record(RecordRequest(out, world, "vlp-16", "handheld", "upright", scans, seed, "ply"), lambda *_: None)
        entries.append(RecordingEntry(out))
    return tuple(entries)


def started(file: Path) -> list[str]:
    """The runs whose processes were started, RECORDING/METHOD."""
    return file.read_text().splitlines() if file.exists() else []


def contents(out: Path) -> dict[str, Any]:
    """The folder of a comparison without times."""
    files: dict[str, Any] = {str(p.relative_to(out)): p.read_bytes() for name in SAME for p in out.rglob(name)}
    for path in out.rglob("comparison.json"):
        content = json.loads(path.read_text())
        for sequence in content.get("sequences", [content]):
            for method in sequence["methods"].values():
                for key in TIMES:
                    method.pop(key)
        files[str(path.relative_to(out))] = content
    return files


@contextmanager
def cluster(starts: Path, kill_after: int | None) -> Iterator[str]:
    """The address of a cluster of two nodes beside its head; one is killed after so many starts."""
    from ray.cluster_utils import Cluster

    ray = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    nodes = [ray.add_node(num_cpus=1) for _ in range(2)]

    def kill() -> None:
        while len(started(starts)) < (kill_after or 0):
            time.sleep(0.1)
        time.sleep(1.0)
        ray.remove_node(nodes[0], allow_graceful=False)

    if kill_after is not None:
        threading.Thread(target=kill, daemon=True).start()
    try:
        yield ray.address
    finally:
        ray.shutdown()


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=int, default=12)
    parser.add_argument("--scans", type=int, default=40)
    parser.add_argument("--methods", default="constant-velocity+map")
    options = parser.parse_args()
    methods = parse_methods(options.methods)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        entries = make_recordings(folder / "recordings", options.recordings, options.scans)
        (folder / "noted.py").write_text(NOTED)

        def run(label: str, where: Callable[[Path], Any]) -> tuple[float, list[str], dict[str, Any]]:
            out, starts = folder / label.replace(" ", "_"), folder / f"{label}.txt"
            command = (sys.executable, str(folder / "noted.py"), str(starts))
            with where(starts) as chosen:
                begun = time.perf_counter()
                compare(CompareRequest(out, entries, methods, where=chosen), quiet, command)
                wall_s = time.perf_counter() - begun
            return wall_s, started(starts), contents(out)

        @contextmanager
        def on_cluster(starts: Path, kill_after: int | None = None) -> Iterator[Where]:
            with cluster(starts, kill_after) as address:
                yield Where(cluster=address)

        quiet = Narrator(lambda _: nullcontext(lambda *_: None), lambda _: None)
        third = options.recordings * len(methods) // 3
        ways: dict[str, Callable[[Path], Any]] = {
            "1 job": lambda _: nullcontext(Where()),
            "2 jobs": lambda _: nullcontext(Where(2)),
            "cluster of 2 nodes": on_cluster,
            "one of them killed": lambda starts: on_cluster(starts, third),
        }
        compare(CompareRequest(folder / "warm", entries[:1], methods), quiet)
        print("| | wall time, s | of one job | runs started | run again | equal |\n|---|---:|---:|---:|---|---|")
        first: tuple[float, list[str], dict[str, Any]] | None = None
        for label, where in ways.items():
            wall_s, starts, files = run(label, where)
            first = first or (wall_s, starts, files)
            again = ", ".join(each for each, times in Counter(starts).items() if times > 1) or "none"
            equal = "yes" if files == first[2] else "no"
            print(
                f"| {label} | {wall_s:.0f} | {wall_s / first[0]:.2f} | {len(starts)} | {again} | {equal} |", flush=True
            )


if __name__ == "__main__":
    main()
