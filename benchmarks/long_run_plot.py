"""Plots of time and memory over the scans of `benchmarks/long_run.py`.

python benchmarks/long_run_plot.py long_run docs/pictures/long_run.png
"""

import argparse
import json
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np


def read(path: Path) -> dict[str, Any]:
    """Columns of a file of JSON lines."""
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("picture", type=Path)
    options = parser.parse_args()
    mpl.use("Agg")
    ours = read(options.folder / "rows.jsonl")
    peers = {path.stem: read(path) for path in sorted(options.folder.glob("*.jsonl")) if path.stem != "rows"}
    figure, (times, memory, counts) = plt.subplots(3, 1, sharex=True, figsize=(7.0, 7.5), layout="constrained")
    times.plot(ours["scans"], ours["cpu_ms"], "k-o", ms=3, label="lidarslam, map and graph")
    memory.plot(ours["scans"], ours["rss_mb"], "k-o", ms=3, label="lidarslam")
    memory.plot(ours["scans"], ours["submaps_mb"], "k--", label="its submaps, on disk")
    memory.plot(ours["scans"], ours["tiles_mb"], "k-.", label="tiles of its map, on disk")
    memory.plot(ours["scans"], ours["state_mb"], "k:", label="its checkpoint, on disk")
    for name, rows in peers.items():
        times.plot(rows["scans"], rows["cpu_ms"], "-o", ms=3, label=name)
        memory.plot(rows["scans"], rows["rss_mb"], "-o", ms=3, label=name)
    counts.plot(ours["scans"], ours["keyframes"], label="keyframes")
    counts.plot(ours["scans"], ours["loops"], label="loop closures")
    times.set_ylabel("CPU, ms per scan")
    memory.set_ylabel("MB")
    counts.set_xlabel(f"scans ({ours['way_km'][-1]:.1f} km)")
    for axes in (times, memory, counts):
        axes.set_ylim(bottom=0.0)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    figure.savefig(options.picture, dpi=90)


if __name__ == "__main__":
    main()
