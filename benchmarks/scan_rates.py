"""Lower scan rates: every simulated world at 1, 2, 3 and 5 times the scan interval.

    python benchmarks/scan_rates.py
    python benchmarks/scan_rates.py RECORDING
    python benchmarks/scan_rates.py RECORDING --worlds office street --motions car --steps 1 5 --methods ct-icp

Prints a Markdown table with a row per recording and step: translation and rotation of the sensor between scans (95th
percentile), and for each method the ATE in metres after SE(3) alignment, with the lost and degraded scans. A failed
peer is reported on standard error and in its cell; ct-icp has no status.

Without recordings, all worlds are simulated, in memory. At n times the scan interval, every n-th scan is used, with all
its points. `--scans` is for the single interval, and the maximum for recordings on disk.
"""

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from mapping_accuracy import (
    DEFAULT_METHODS,
    METHODS,
    Recorded,
    add_simulation_arguments,
    errors_of,
    localise,
    make_parser,
    print_header,
    print_row,
    recordings,
    true_trajectory,
)
from peers import NAMES, run_peer

from lidarslam.compare.peers.interface import PeerError
from lidarslam.core.geometry import rotation_angle


def every_nth(recorded: Recorded, step: int) -> Recorded:
    """The recording with every `step`-th scan."""
    return replace(recorded, scans=recorded.scans[::step])


def result(method: str, recorded: Recorded) -> str:
    """Cell of a method."""
    if method in METHODS:
        return localise(recorded, METHODS[method]).text()
    try:
        return f"{errors_of(run_peer(method, recorded.scans), recorded).ate_rmse_m:.3f}"
    except PeerError as error:
        print(f"{method}: {error}", file=sys.stderr, flush=True)
        return "failed"


def row(recorded: Recorded, step: int, methods: Sequence[str]) -> list[str]:
    chosen = every_nth(recorded, step)
    motions = true_trajectory(chosen).relative_motions()
    moved_m = float(np.percentile(np.linalg.norm(motions[:, :3, 3], axis=1), 95.0))
    turned_deg = float(np.rad2deg(np.percentile(rotation_angle(motions), 95.0)))
    cells = [recorded.name, str(step), str(len(chosen.scans)), f"{moved_m:.2f}", f"{turned_deg:.1f}"]
    for method in methods:
        cells.append(result(method, chosen))
        print(f"{recorded.name} step {step} {method}: {cells[-1]}", file=sys.stderr, flush=True)
    return cells


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("sources", nargs="*", type=Path, help="recordings with ground truth")
    add_simulation_arguments(parser, motions=("car", "tracked"))
    parser.add_argument("--steps", nargs="+", type=int, default=[1, 2, 3, 5], help="times the scan interval")
    parser.add_argument("--methods", nargs="+", choices=[*METHODS, *NAMES], default=[*DEFAULT_METHODS, "ct-icp"])
    options = parser.parse_args()
    print_header(["recording", "step", "scans", "moved per scan, m", "turned, deg", *options.methods])
    for recorded in recordings(options, options.scans):
        for step in options.steps:
            print_row(row(recorded, step, options.methods))


if __name__ == "__main__":
    main()
