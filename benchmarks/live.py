"""Test whether `lidarslam live` keeps up with a sensor: another process on this machine plays a bag over DDS.

    python benchmarks/live.py RECORDING [--rate 10] [--pad 65536] [--scans 200] [--rows default,constant-velocity]

The clouds are padded to the load of an OS1-64 (1024 x 64 points of 48 bytes, 3 MB) and stamped with their due times,
best effort, as by ouster-ros. Printed for each choice of methods: clouds received; missing between them; dropped
because registration was behind; latency from the due time of a cloud to the publication of its pose, and time of
decoding and registration, each as median and 99th percentile; lost scans; the load of other programs before. Needs the
extra `live`.
"""

import argparse
import csv
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

ROWS = {
    "default": [],
    "constant-velocity": ["--odometry", "constant-velocity"],
    "pose graph": ["--pose-graph"],
    "learned alone": ["--no-mapping"],
    "kiss-icp": ["--odometry", "kiss-icp"],
}
_FOUND = re.compile(r"(\d[\d,]*) messages? received, (\d+) missing between their stamps, (\d+) dropped")
_LATENCY = re.compile(r"from the stamp of a scan to its pose: median (\d+) ms, p99 (\d+) ms")


def follow(given: argparse.Namespace, options: list[str], out: Path) -> str:
    """Play the recording to a live run; one row of the table."""
    load = os.getloadavg()[0]
    domain, topic = ["--domain", str(given.domain)], ["--topic", "/ouster/points"]
    live = [sys.executable, "-m", "lidarslam", "live", *domain, *topic, "-o", str(out), "--overwrite", "--no-report"]
    play = [sys.executable, str(Path(__file__).with_name("play_bag.py")), str(given.recording), *domain, *topic]
    paced = ["--restamp", "--rate", str(given.rate), "--pad", str(given.pad), "--scans", str(given.scans)]
    ends = ["--duration", f"{(given.scans - 1.5) / given.rate:.3f}"]
    with subprocess.Popen([*play, *paced], stdout=subprocess.DEVNULL) as player:
        done = subprocess.run([*live, *ends, *options], capture_output=True, text=True, check=False, timeout=500)
        player.wait()
    counts, latency = _FOUND.search(done.stdout), _LATENCY.search(done.stdout)
    if counts is None or latency is None:
        raise SystemExit(done.stdout + done.stderr)
    stage_ms = read_stages(out / "scans.csv")
    lost = json.loads((out / "summary.json").read_text())["lost_scans"]
    return (
        f"{counts[1]:>9}{counts[2]:>9}{counts[3]:>9}{latency[1]:>10}{latency[2]:>8}"
        f"{np.median(stage_ms):>12.0f}{np.percentile(stage_ms, 99):>8.0f}{lost:>6}{load:>7.1f}"
    )


def read_stages(file: Path) -> list[float]:
    """Milliseconds from reading a scan to its pose."""
    with file.open() as lines:
        rows = list(csv.DictReader(lines))
    return [sum(float(row[f"ms_{stage}"]) for stage in ("read", "odometry", "refine", "check")) for row in rows]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path, help="a ROS 2 bag, such as of `lidarslam simulate --sensor os1-64`")
    parser.add_argument("--rate", type=float, default=10.0, help="scans per second")
    parser.add_argument("--pad", type=int, default=65_536, metavar="POINTS")
    parser.add_argument("--scans", type=int, default=200, help="number of scans")
    parser.add_argument("--domain", type=int, default=97)
    parser.add_argument("--rows", default="default,constant-velocity,pose graph,learned alone")
    given = parser.parse_args()
    print(f"{given.scans} scans at {given.rate:g} Hz, {os.cpu_count()} cores")
    print(" " * 20 + " received  missing  dropped latency ms   p99  computing ms  p99  lost   load")
    with tempfile.TemporaryDirectory() as folder:
        for name in given.rows.split(","):
            print(f"{name:20}{follow(given, ROWS[name], Path(folder) / 'run')}", flush=True)


if __name__ == "__main__":
    main()
