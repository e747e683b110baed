"""The odometries from scan to scan, beside one another: how wrong each motion is, on recordings training never saw.

    python benchmarks/odometry_accuracy.py --worlds office street --motions tracked car --scans 100
    python benchmarks/odometry_accuracy.py KITTI/sequences/04

Prints a Markdown table, three rows for each recording: the network's guess alone, the learned odometry (the guess
refined by alignment), and KISS-ICP with its defaults, which matches scans to its own map. Motions are those between the
stamps of consecutive scans; RMS of their errors, and the ATE of the trajectory they are chained to. `covered` is the
share of the motions whose error lies within what 95 % should by the covariance that comes with it. Processor time is of
this process; KISS-ICP's is in another and not counted.
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mapping_accuracy import (
    Recorded,
    add_simulation_arguments,
    errors_of,
    print_header,
    print_row,
    recordings,
    true_trajectory,
)
from scipy.special import erf
from scipy.stats import chi2

from lidarslam.core.geometry import FloatArray, inverse, log, rotation_angle
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory, chain
from lidarslam.odometry.config import LearnedConfig, OdometryConfig
from lidarslam.odometry.interface import Motion
from lidarslam.odometry.registry import make_odometry

# Numbers of standard deviations, and the share of errors that should lie within each.
SIGMAS = (1, 2, 3)
EXPECTED_SHARES = tuple(float(erf(sigma / np.sqrt(2.0))) for sigma in SIGMAS)

_COVERED_95 = float(chi2.ppf(0.95, 6))


@dataclass(frozen=True)
class Errors:
    """What is wrong with a method's motions on one recording; `covered_percent` is None without covariances."""

    rotation_deg: float
    translation_m: float
    ate_m: float
    failures: int
    covered_percent: float | None
    cpu_ms: float


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="*", type=Path, help="recordings with ground truth")
    add_simulation_arguments(parser)
    parser.add_argument("--weights", type=Path, help="of the learned odometry, instead of the program's own")
    options = parser.parse_args(arguments)
    columns = ("recording", "step, m", "turn, deg", "method", "rotation, deg", "translation, cm", "% of the step")
    print_header([*columns, "ATE, m", "failed", "covered, %", "CPU, ms a scan"])
    methods = _methods(options.weights)
    for recorded in recordings(options):
        _print(recorded, methods)


def network_alone(weights: Path | None) -> LearnedConfig:
    """The learned odometry without alignment."""
    return LearnedConfig(weights=weights, alignment=False)


def _methods(weights: Path | None) -> dict[str, OdometryConfig]:
    return {
        "network alone": OdometryConfig(learned=network_alone(weights)),
        "learned": OdometryConfig(learned=LearnedConfig(weights=weights)),
        "KISS-ICP": OdometryConfig(method="kiss-icp"),
    }


def _print(recorded: Recorded, methods: dict[str, OdometryConfig]) -> None:
    truth = true_trajectory(recorded)
    motions = truth.relative_motions()
    step, turn = rms(np.linalg.norm(motions[:, :3, 3], axis=1)), np.rad2deg(rms(rotation_angle(motions)))
    for name, config in methods.items():
        errors = _try(config, recorded, truth)
        covered = "" if errors.covered_percent is None else f"{errors.covered_percent:.0f}"
        motion = [f"{errors.rotation_deg:.2f}", f"{100.0 * errors.translation_m:.1f}"]
        motion.append(f"{100.0 * errors.translation_m / step:.0f}")
        result = [
            f"{errors.ate_m:.2f}",
            str(errors.failures),
            covered,
            "" if config.method == "kiss-icp" else f"{errors.cpu_ms:.0f}",
        ]
        print_row([recorded.name, f"{step:.2f}", f"{turn:.1f}", name, *motion, *result])


def _try(config: OdometryConfig, recorded: Recorded, truth: Trajectory) -> Errors:
    started = time.process_time()
    motions = estimated_motions(config, recorded.scans)
    cpu_ms = 1e3 * (time.process_time() - started) / len(motions)
    estimated = np.array([motion.T_prev_curr for motion in motions[1:]])
    wrong = inverse(estimated) @ truth.relative_motions()
    trajectory = Trajectory(truth.stamps, chain(truth.T_world_lidar[0], estimated))
    return Errors(
        rotation_deg=float(np.rad2deg(rms(rotation_angle(wrong)))),
        translation_m=rms(np.linalg.norm(wrong[:, :3, 3], axis=1)),
        ate_m=errors_of(trajectory, recorded).ate_rmse_m,
        failures=sum(motion.failure is not None for motion in motions),
        covered_percent=_covered_percent(motions[1:], log(wrong)),
        cpu_ms=cpu_ms,
    )


def estimated_motions(config: OdometryConfig, scans: Sequence[Scan]) -> list[Motion]:
    """What an odometry alone says of each scan."""
    odometry = make_odometry(config)
    try:
        return [odometry.estimate(scan) for scan in scans]
    finally:
        odometry.close()


def _covered_percent(motions: Sequence[Motion], errors: FloatArray) -> float | None:
    """Of the errors (N, 6), those within the 95 % ellipsoid of their covariance."""
    squared = squared_errors([motion.covariance for motion in motions], errors)
    squared = squared[np.isfinite(squared)]
    return 100.0 * float(np.mean(squared <= _COVERED_95)) if len(squared) else None


def squared_errors(covariances: Sequence[FloatArray | None], errors: FloatArray) -> FloatArray:
    """(N,) of errors (N, 6), in standard deviations, summed over the six directions; NaN without a covariance."""
    return np.array(
        [
            np.nan if covariance is None else error @ np.linalg.solve(covariance, error)
            for covariance, error in zip(covariances, errors, strict=True)
        ]
    )


def shares_within_sigmas(squared: FloatArray) -> list[float]:
    """Of squared errors (N,) as above, the shares that lie within each of `SIGMAS`."""
    return [float(np.mean(squared <= chi2.ppf(share, 6))) for share in EXPECTED_SHARES]


def rms(values: FloatArray) -> float:
    """The root of the mean of their squares."""
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    main()
