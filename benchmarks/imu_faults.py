"""Faults of an IMU: the resulting ATE, and whether a warning names the fault.

    python benchmarks/imu_faults.py sim_stairs sim_corridor_yard
    python benchmarks/imu_faults.py sim_stairs --faults "1 deg/s bias" "20 ms late" --options --step 5

A recording is a folder of scans with `imu.csv` and ground truth. Each fault is applied to a copy of the samples, and
the recording is run with `--odometry learned+imu`. Prints a Markdown table: ATE in metres after SE(3) alignment, lost
scans, exit status, and the warnings, or the error message, that name the fault.
"""

import argparse
import json
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from click.testing import CliRunner
from mapping_accuracy import make_parser, print_header, print_row

from lidarslam.cli import main as lidarslam
from lidarslam.core.geometry import FloatArray

# Rows of `imu.csv`: stamp, angular velocity (rad/s), specific force (m/s^2).
STAMP, RATE, FORCE = slice(0, 1), slice(1, 4), slice(4, 7)
# Words in warnings that name a fault.
ANY = ("IMU", "gyroscope", "accelerometer")


def _changed(columns: slice, times: float = 1.0, plus: float = 0.0) -> Callable[[FloatArray], FloatArray]:
    def change(rows: FloatArray) -> FloatArray:
        rows[:, columns] = times * rows[:, columns] + plus
        return rows

    return change


def _dropped(rows: FloatArray) -> FloatArray:
    return np.asarray(rows[np.random.default_rng(0).random(len(rows)) > 0.1])


def _swapped(rows: FloatArray) -> FloatArray:
    return np.asarray(rows[:, [0, 2, 1, 3, 5, 4, 6]])


def _saturated(rows: FloatArray) -> FloatArray:
    """A gyroscope that saturates at nine tenths of the largest rate."""
    largest = 0.9 * np.abs(rows[:, RATE]).max()
    rows[:, RATE] = np.clip(rows[:, RATE], -largest, largest)
    return rows


FAULTS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "none": lambda rows: rows,
    "0.1 g bias": _changed(FORCE, plus=0.981 / np.sqrt(3.0)),
    "1 deg/s bias": _changed(RATE, plus=np.deg2rad(1.0) / np.sqrt(3.0)),
    "20 ms late": _changed(STAMP, plus=0.02),
    "20 ms early": _changed(STAMP, plus=-0.02),
    "10 % dropped": _dropped,
    "saturated": _saturated,
    "deg/s": _changed(RATE, times=np.rad2deg(1.0)),
    "g": _changed(FORCE, times=1.0 / 9.80665),
    "gyroscope reversed": _changed(RATE, times=-1.0),
    "accelerometer reversed": _changed(FORCE, times=-1.0),
    "x and y swapped": _swapped,
}


def faulty(source: Path, folder: Path, fault: str) -> Path:
    """A copy of a recording with a fault in its samples; scans are links."""
    lines = (source / "imu.csv").read_text().splitlines()
    header = [line for line in lines if line.startswith("#")]
    rows = FAULTS[fault](np.loadtxt([line for line in lines if not line.startswith("#")], delimiter=","))
    copy = folder / source.name
    copy.mkdir()
    for file in source.iterdir():
        if file.name != "imu.csv":
            (copy / file.name).symlink_to(file.resolve())
    np.savetxt(copy / "imu.csv", rows, fmt="%.9f", delimiter=",", header="\n".join(header), comments="")
    return copy


def row(source: Path, fault: str, options: list[str]) -> list[str]:
    with tempfile.TemporaryDirectory() as temporary:
        copy, out = faulty(source, Path(temporary), fault), Path(temporary) / "run"
        arguments = ["run", str(copy), "--out", str(out), "--odometry", "learned+imu", "--no-report", *options]
        done = CliRunner().invoke(lidarslam, arguments)
        if not (out / "summary.json").exists():
            return [source.name, fault, "-", "-", str(done.exit_code), done.output.strip().splitlines()[-1]]
        summary = json.loads((out / "summary.json").read_text())
        metrics = json.loads((out / "metrics.json").read_text())
    named = [warning for warning in summary["warnings"] if any(word in warning for word in ANY)]
    ate = f"{metrics['trajectory']['ate_rmse_m']:.3f}"
    return [source.name, fault, ate, str(summary["lost_scans"]), str(done.exit_code), "; ".join(named)]


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("sources", nargs="+", type=Path, help="folders of scans with imu.csv and ground truth")
    parser.add_argument("--faults", nargs="+", choices=FAULTS, default=list(FAULTS))
    parser.add_argument("--options", nargs=argparse.REMAINDER, default=[], help="options of lidarslam run")
    arguments = parser.parse_args()
    print_header(["recording", "fault", "ATE, m", "lost", "exit", "reported"])
    for source in arguments.sources:
        for fault in arguments.faults:
            print_row(row(source, fault, arguments.options))


if __name__ == "__main__":
    main()
