"""Every method from many starts of real recordings: do runs with exit status 0 have a correct trajectory?

    python benchmarks/real_starts.py 2011_09_26/2011_09_26_drive_0005_sync KITTI/sequences/04
    python benchmarks/real_starts.py RECORDING --steps 1 2 3 5 --every 20 --methods learned+map ct-icp --all
    python benchmarks/real_starts.py RECORDING --every 100000 --scans 1000 --yaws 0 30 60 --methods learned+map

Prints a Markdown table with a row per recording, method and scan step. Runs have `--scans` scans and begin at every
`--every`-th scan of the recording; near its end they have what is left, if that is half of `--scans` or more. With
`--yaws`, our methods run again with the axes turned by each angle: the same points fall into other cells.

- worst, median ATE: metres, after SE(3) alignment, over the starts; with ground truth only;
- worst start: first scan of the worst run, by ATE, or by path length without ground truth;
- worst length error: of the path length against ground truth, or without it against KISS-ICP's, in % of the latter or
  of 10 metres, whichever is longer. With `--lengths-of KISS-ICP` always against KISS-ICP's, for recordings whose ground
  truth is satellite navigation with errors of several percent over such short runs;
- lost, degraded: scans of all runs;
- exit 0: runs with exit status 0, and the number of these whose length is wrong by more than 3 %.

Our methods and KISS-ICP run as in `lidarslam run`, with its exit status; for KISS-ICP that is `--no-mapping`, where
each scan is compared with the previous one. Other peers have no status; they count as 0 if their process completes.
"""

import argparse
import json
import logging
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from click.testing import CliRunner
from mapping_accuracy import make_parser, print_header, print_row
from peers import run_peer

from lidarslam.cli import main as lidarslam
from lidarslam.compare.peers.estimation import PEERS
from lidarslam.compare.peers.interface import PeerError
from lidarslam.core.trajectory import Trajectory, read_tum
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.registry import open_recording
from lidarslam.evaluation.trajectory.alignment import associate
from lidarslam.evaluation.trajectory.metrics import evaluate_trajectory
from lidarslam.pipeline.threads import in_order

# Methods of `lidarslam run`, and their options.
OPTIONS: dict[str, tuple[str, ...]] = {
    "learned+map": (),
    "learned+loam": ("--mapping", "loam"),
    "constant-velocity+map": ("--odometry", "constant-velocity"),
    "learned+imu+map": ("--odometry", "learned+imu"),
    "constant-velocity+loam": ("--odometry", "constant-velocity", "--mapping", "loam"),
    "KISS-ICP": ("--odometry", "kiss-icp", "--no-mapping"),
}
METHODS = (*OPTIONS, *PEERS)
DEFAULT_METHODS = ("learned+map", "constant-velocity+map", "KISS-ICP", "ct-icp")
REFERENCE = "KISS-ICP"
# Minimum length to which length errors are relative; limit of the length error.
SHORTEST_M, WRONG_PERCENT = 10.0, 3.0


@dataclass(frozen=True, eq=False)
class Ended:
    """A completed run."""

    trajectory: Trajectory | None
    # lost, degraded: scans; None for a method without a status
    lost: int | None
    degraded: int | None
    status: int  # exit status
    message: str = ""  # why there is no trajectory


@dataclass(frozen=True)
class Judged:
    """A run from one start, evaluated by ground truth or the reference; None where unknown."""

    start: int
    scans: int
    ate_m: float | None
    length_error_percent: float | None
    lost: int | None
    degraded: int | None
    status: int

    @property
    def badness(self) -> float:
        """Sorting key of runs."""
        value = self.length_error_percent if self.ate_m is None else self.ate_m
        return float("inf") if value is None else abs(value)


def starts_of(scans: int, every: int, wanted: int, step: int) -> list[range]:
    """The scans of each run; all but the first have at least half of the wanted number."""
    runs = [range(start, min(start + wanted * step, scans), step) for start in range(0, scans, every)]
    return [run for run in runs if run.start == 0 or 2 * len(run) >= wanted]


def run_ours(method: str, source: Path, scans: range, yaw_deg: float = 0.0) -> Ended:
    """A run of the command line, with the axes turned by an angle."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        where = ["--start", str(scans.start), "--stop", str(scans.stop), "--step", str(scans.step)]
        where += ["--set", f"reader.mounting=[0, 0, {yaw_deg}]"] if yaw_deg else []
        done = CliRunner().invoke(lidarslam, ["run", str(source), "--out", str(out), *where, *OPTIONS[method]])
        if done.exception is not None and not isinstance(done.exception, SystemExit):
            raise done.exception
        if not (out / "summary.json").exists():
            return Ended(None, None, None, done.exit_code, done.output.strip())
        summary = json.loads((out / "summary.json").read_text())
        trajectory = read_tum(out / "trajectory.tum")
    return Ended(trajectory, summary["lost_scans"], summary["degraded_scans"], done.exit_code)


def run_other(method: str, recording: Recording, scans: range) -> Ended:
    """A run of a peer."""
    try:
        trajectory = run_peer(method, in_order(recording.scans(scans.start, scans.stop, scans.step)), recording.imu)
    except PeerError as error:
        return Ended(None, None, None, 1, str(error))
    return Ended(trajectory, None, None, 0)


def judge(ended: Ended, scans: range, truth: Trajectory | None, of_length: Trajectory | None) -> Judged:
    """Evaluate a run by ground truth, and its path length by that of another trajectory."""
    trajectory = ended.trajectory
    ate_m = length_error_percent = None
    if trajectory is not None and of_length is not None:
        length_error_percent = length_error(trajectory, of_length)
    if trajectory is not None and truth is not None:
        ate_m = evaluate_trajectory(trajectory, truth).errors.ate_rmse_m
    return Judged(scans.start, len(scans), ate_m, length_error_percent, ended.lost, ended.degraded, ended.status)


def length_error(trajectory: Trajectory, reference: Trajectory) -> float:
    """Error of a path length relative to the reference at the same instants, in percent."""
    matched = associate(trajectory, reference)
    true_m = matched.reference.length_m
    return 100.0 * (matched.estimate.length_m - true_m) / max(true_m, SHORTEST_M)


def judged_runs(
    source: Path, recording: Recording, step: int, arguments: argparse.Namespace
) -> Iterator[tuple[str, Judged]]:
    """Runs of every method from every start, with its name."""
    truth = recording.ground_truth
    methods = sorted(arguments.methods, key=lambda name: name != REFERENCE)
    uses_reference = truth is None or arguments.lengths_of == REFERENCE
    if uses_reference and REFERENCE not in methods:
        methods.insert(0, REFERENCE)
    for scans in starts_of(len(recording), arguments.every, arguments.scans, step):
        of_length = None if uses_reference else truth
        runs = [(method, yaw_deg) for method in methods for yaw_deg in (arguments.yaws if method in OPTIONS else [0.0])]
        for method, yaw_deg in runs:
            is_ours = method in OPTIONS
            ended = run_ours(method, source, scans, yaw_deg) if is_ours else run_other(method, recording, scans)
            if method == REFERENCE and of_length is None:
                of_length = ended.trajectory
            judged = judge(ended, scans, truth, of_length)
            _report(f"{recording.name} step {step} start {scans.start} {method}: {_line(judged)} {ended.message}")
            yield method, judged


def _line(judged: Judged) -> str:
    return f"ATE {_metres(judged.ate_m)} m, length {_percent(judged.length_error_percent)} %, exit {judged.status}"


def _report(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def row(name: str, method: str, step: int, runs: Sequence[Judged]) -> list[str]:
    worst = max(runs, key=lambda run: run.badness)
    ates = [run.ate_m for run in runs if run.ate_m is not None]
    errors = [run.length_error_percent for run in runs if run.length_error_percent is not None]
    ok = [run for run in runs if run.status == 0]
    wrong = [run for run in ok if run.length_error_percent is None or abs(run.length_error_percent) > WRONG_PERCENT]
    return [
        name,
        str(step),
        method,
        str(len(runs)),
        _metres(max(ates, default=None)),
        _metres(float(np.median(ates)) if ates else None),
        str(worst.start),
        _percent(max(errors, key=abs, default=None)),
        _total([run.lost for run in runs]),
        _total([run.degraded for run in runs]),
        str(len(ok)),
        str(len(wrong)),
    ]


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:+.1f}"


def _total(counts: Sequence[int | None]) -> str:
    known = [count for count in counts if count is not None]
    return str(sum(known)) if known else "-"


def print_starts(name: str, step: int, runs: dict[str, list[Judged]]) -> None:
    """Print a table with a row per run."""
    print_header(["recording", "step", "method", "start", "scans", "ATE, m", "length, %", "lost", "degraded", "exit"])
    for method, judged in runs.items():
        for run in judged:
            counts = [_total([run.lost]), _total([run.degraded]), str(run.status)]
            where = [name, str(step), method, str(run.start), str(run.scans)]
            print_row([*where, _metres(run.ate_m), _percent(run.length_error_percent), *counts])
    print(flush=True)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("sources", nargs="+", type=Path, help="recordings")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=DEFAULT_METHODS)
    parser.add_argument("--steps", nargs="+", type=int, default=[1], help="take every n-th scan")
    parser.add_argument("--every", type=int, default=10, help="scans between starts")
    parser.add_argument("--scans", type=int, default=50, help="per run")
    parser.add_argument("--lengths-of", choices=["truth", REFERENCE], default="truth", help="reference of path lengths")
    parser.add_argument(
        "--yaws", nargs="+", type=float, default=[0.0], help="angles by which the axes are turned, degrees"
    )
    parser.add_argument("--all", action="store_true", help="print every run, too")
    options = parser.parse_args()
    rows = []
    logging.basicConfig(stream=sys.stderr, level=logging.ERROR)  # not to a run's streams, which end with it
    for source in options.sources:
        recording = open_recording(source)
        for step in options.steps:
            runs: dict[str, list[Judged]] = {method: [] for method in options.methods}
            for method, judged in judged_runs(source, recording, step, options):
                runs.setdefault(method, []).append(judged)
            if options.all:
                print_starts(recording.name, step, runs)
            rows += [row(recording.name, method, step, judged) for method, judged in runs.items()]
    header = ["recording", "step", "method", "starts", "worst ATE, m", "median ATE, m", "worst start"]
    header += ["worst length error, %", "lost", "degraded", "exit 0"]
    header += [f"of these, length wrong by more than {WRONG_PERCENT:g} %"]
    print_header(header)
    for cells in rows:
        print_row(cells)


if __name__ == "__main__":
    main()
