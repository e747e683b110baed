"""The learned odometry alone on real drives held out of its training, at several rates, compared with KISS-ICP.

    python benchmarks/held_out.py DRIVE=weights.safetensors ANOTHER=others.safetensors --steps 1 2 3 5

Weights are given per recording, from a training without that recording; by default, the included weights are used. The
reference is the recording's ground truth, or with `--mapped` (for drives whose GPS is off by decimetres) the trajectory
of scan-to-map registration at constant velocity and full rate. Prints a Markdown table with a row per recording, step
and method: drift over segments of 20 to 60 m from every scan, error of the rotation from scan to scan (RMSE) and of the
translation (largest), lost scans, and the shares of errors within one, two and three standard deviations of the
covariance (chi-square with six degrees of freedom: 68.3, 95.4, 99.7 % if it is correct). With `--starts N`, runs of 50
scans from every N-th scan are added, with one row for all of them.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from covariance import estimated_motions, shares_within_sigmas, squared_errors
from mapping_accuracy import (
    METHODS,
    Recorded,
    make_parser,
    pipeline_results,
    print_header,
    print_row,
    read,
    trajectory_of,
    true_trajectory,
)

from lidarslam.core.geometry import FloatArray, inverse, log, rotation_angle
from lidarslam.core.trajectory import Trajectory, chain
from lidarslam.datasets.registry import open_recording
from lidarslam.evaluation.trajectory.alignment import Association
from lidarslam.evaluation.trajectory.metrics import segment_errors
from lidarslam.odometry.config import LearnedConfig, OdometryConfig
from lidarslam.odometry.interface import Motion
from lidarslam.pipeline.threads import in_order

LENGTHS_M = (20.0, 30.0, 40.0, 50.0, 60.0)
_SCANS_OF_A_START = 50


@dataclass(frozen=True, eq=False)
class Outcome:
    """Runs of one method on parts of one recording."""

    drift_percent: FloatArray  # (M,) of all segments
    wrong: FloatArray  # (N, 4, 4) errors of the motions between scans
    squared: FloatArray  # (N,) their squared Mahalanobis norms; NaN without a covariance
    lost: int  # scans

    def cells(self) -> list[str]:
        """Drift, rotation, translation, lost scans, shares within 1, 2, 3 sigma."""
        drift = f"{float(np.mean(self.drift_percent)):.2f}" if len(self.drift_percent) else "too short"
        known = self.squared[np.isfinite(self.squared)]
        shares = ", ".join(f"{100.0 * share:.0f}" for share in shares_within_sigmas(known)) if len(known) else ""
        rotation_deg = float(np.rad2deg(rms(rotation_angle(self.wrong))))
        largest_m = float(np.linalg.norm(self.wrong[:, :3, 3], axis=1).max())
        return [drift, f"{rotation_deg:.3f}", f"{largest_m:.2f}", str(self.lost), shares]


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("sources", nargs="+", metavar="RECORDING[=WEIGHTS]")
    parser.add_argument("--steps", type=int, nargs="+", default=[1, 2, 3, 5])
    parser.add_argument("--starts", type=int, help="also runs of 50 scans from every N-th scan, at full rate")
    parser.add_argument("--mapped", action="store_true", help="use the mapped trajectory as reference")
    options = parser.parse_args()
    columns = ("recording", "scans", "m per scan", "method", "drift, %", "rotation, deg", "largest error, m", "lost")
    print_header([*columns, "within 1, 2, 3 sigma, %"])
    for source in options.sources:
        name, _, weights = source.partition("=")
        recorded = mapped(Path(name)) if options.mapped else with_truth(Path(name))
        methods = {
            "learned": OdometryConfig(learned=LearnedConfig(weights=Path(weights) if weights else None)),
            "KISS-ICP": OdometryConfig(method="kiss-icp"),
        }
        for label, parts in _parts(recorded, options):
            step_m = rms(np.concatenate([_steps_m(part) for part in parts]))
            for method, config in methods.items():
                outcome = joined([judged(part, estimated_motions(config, part.scans)) for part in parts])
                print_row([recorded.name, label, f"{step_m:.2f}", method, *outcome.cells()])


def rms(values: FloatArray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def with_truth(source: Path) -> Recorded:
    """A recording with ground truth at its scans' stamps."""
    recorded = read(source)
    return replace(recorded, truth=true_trajectory(recorded))


def mapped(source: Path) -> Recorded:
    """A recording with the trajectory of scan-to-map registration as ground truth."""
    recording = open_recording(source)
    scans = list(in_order(recording.scans()))
    results = pipeline_results(scans, METHODS["constant-velocity+map"])
    return Recorded(recording.name, scans, trajectory_of(results))


def _parts(recorded: Recorded, options: argparse.Namespace) -> Iterator[tuple[str, list[Recorded]]]:
    """Label and runs of each row: the recording at a rate, or many short runs."""
    for step in options.steps:
        label = "every" if step == 1 else f"every {step}"
        yield label, [replace(recorded, scans=recorded.scans[::step])]
    if options.starts:
        count = len(recorded.scans)
        begins = range(0, max(count - _SCANS_OF_A_START, 0) + 1, options.starts)
        runs = [replace(recorded, scans=recorded.scans[begin : begin + _SCANS_OF_A_START]) for begin in begins]
        yield f"{len(runs)} starts", runs


def _steps_m(recorded: Recorded) -> FloatArray:
    motions = true_trajectory(recorded).relative_motions()
    return np.asarray(np.linalg.norm(motions[:, :3, 3], axis=1), dtype=np.float64)


def judged(recorded: Recorded, motions: Sequence[Motion]) -> Outcome:
    """Evaluate the motions of one run."""
    truth = true_trajectory(recorded)
    estimated = np.array([motion.T_prev_curr for motion in motions[1:]])
    wrong = inverse(estimated) @ truth.relative_motions()
    trajectory = Trajectory(truth.stamps, chain(truth.T_world_lidar[0], estimated))
    matched = Association(trajectory, truth, np.arange(len(truth)), len(truth), len(truth))
    errors = segment_errors(matched, LENGTHS_M, step=1, over_travelled=True)
    covariances = [motion.covariance for motion in motions[1:]]
    return Outcome(
        drift_percent=100.0 * errors.translation,
        wrong=wrong,
        squared=squared_errors(covariances, log(wrong)),
        lost=sum(motion.failure is not None for motion in motions),
    )


def joined(outcomes: Sequence[Outcome]) -> Outcome:
    """Combine all runs."""
    drift, wrong, squared = (
        np.concatenate([getattr(one, name) for one in outcomes]) for name in ("drift_percent", "wrong", "squared")
    )
    return Outcome(drift, wrong, squared, sum(one.lost for one in outcomes))


if __name__ == "__main__":
    main()
