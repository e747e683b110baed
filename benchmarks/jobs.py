"""Wall time of a comparison of 12 recordings: one job, two jobs, a Ray cluster of two nodes, and with one node killed.

    python benchmarks/jobs.py
    python benchmarks/jobs.py --recordings 4 --scans 20 --methods constant-velocity+map,learned+map

The recordings are simulated. The nodes of the cluster are on this machine, with one CPU each; one is killed with all
its processes when a third of the runs have been started. `run again` lists runs that were started more than once;
`same files` is yes if configuration, trajectories and map of every run are byte-identical to those of one job;
`figures` is the largest relative difference of an error in comparison.json. The exit status is 1 if files differ, or
figures by more than rounding.
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

from lidarslam.compare.comparison import compare
from lidarslam.compare.plan import CompareRequest, RecordingEntry, parse_methods
from lidarslam.core.tasks import Where
from lidarslam.simulation.record import RecordRequest, record

WORLDS = ("office", "street", "hall", "tunnel")
ROUNDING = 1e-9
SAME = ("config.yaml", "map.ply", "odometry.tum", "trajectory.tum", "trajectory.kitti")

# Records the start of a method, then replaces itself by the method's process.
NOTED = """
import json, os, sys
from pathlib import Path
out = Path(json.loads(sys.argv[-1])["out"])
with open(sys.argv[1], "a") as file: file.write(f"{out.parent.name}/{out.name}\\n")
os.execv(sys.executable, [sys.executable, "-m", "lidarslam.compare.method_run", *sys.argv[2:]])
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
    """Runs whose processes were started, RECORDING/METHOD."""
    return file.read_text().splitlines() if file.exists() else []


def contents(out: Path) -> dict[str, bytes]:
    """Files without times of all runs of a comparison."""
    return {str(path.relative_to(out)): path.read_bytes() for name in SAME for path in out.rglob(name)}


def figures(out: Path) -> dict[str, float]:
    """Errors of all runs by their names in comparison.json."""
    content = json.loads((out / "comparison.json").read_text())
    found: dict[str, float] = {}

    def walk(value: Any, name: str) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                walk(inner, f"{name}/{key}")
        elif isinstance(value, float):
            found[name] = value

    for sequence in content.get("sequences", [content]):
        for method, entry in sequence["methods"].items():
            walk(entry["metrics"], f"{sequence['sequence']}/{method}")
    return found


def largest_difference(one: dict[str, float], other: dict[str, float]) -> float:
    """Largest relative difference of two sets of figures; infinite if their names differ."""
    if one.keys() != other.keys():
        return float("inf")
    return max((abs(value - other[name]) / max(abs(value), 1e-300) for name, value in one.items()), default=0.0)


@contextmanager
def cluster(starts: Path, kill_after: int | None) -> Iterator[str]:
    """Address of a cluster of a head and two nodes, one of which is killed after `kill_after` starts."""
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

        @contextmanager
        def on_cluster(starts: Path, kill_after: int | None = None) -> Iterator[Where]:
            with cluster(starts, kill_after) as address:
                yield Where(cluster=address)

        third = options.recordings * len(methods) // 3
        ways: dict[str, Callable[[Path], Any]] = {
            "1 job": lambda _: nullcontext(Where()),
            "2 jobs": lambda _: nullcontext(Where(2)),
            "cluster of 2 nodes": on_cluster,
            "one of them killed": lambda starts: on_cluster(starts, third),
        }
        compare(CompareRequest(folder / "warm", entries[:1], methods), lambda _: None)
        print("| | wall time, s | of one job | runs started | run again | same files | figures |")
        print("|---|---:|---:|---:|---|---|---:|")
        first, is_same = None, True
        for label, where in ways.items():
            out, noted = folder / label.replace(" ", "_"), folder / f"{label}.txt"
            command = (sys.executable, str(folder / "noted.py"), str(noted))
            with where(noted) as chosen:
                begun = time.perf_counter()
                compare(CompareRequest(out, entries, methods, where=chosen), lambda _: None, command)
                wall_s = time.perf_counter() - begun
            starts, files, errors = started(noted), contents(out), figures(out)
            first = first or (wall_s, files, errors)
            again = ", ".join(each for each, times in Counter(starts).items() if times > 1) or "none"
            same = "yes" if files == first[1] else "no"
            difference = largest_difference(first[2], errors)
            is_whole = len(files) == len(SAME) * options.recordings * len(methods)
            is_same &= is_whole and same == "yes" and difference < ROUNDING
            row = (label, f"{wall_s:.0f}", f"{wall_s / first[0]:.2f}", len(starts), again, same, f"{difference:.0e}")
            print("| " + " | ".join(map(str, row)) + " |", flush=True)
    sys.exit(0 if is_same else 1)


if __name__ == "__main__":
    main()
