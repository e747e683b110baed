"""Consistency of the covariances of poses and motions: normalised estimation error squared (NEES) by ground truth.

    python benchmarks/covariance.py
    python benchmarks/covariance.py KITTI/sequences/04 --worlds street --motions car --scans 100 --methods learned+map

Prints a Markdown table with up to three rows per recording and method. With the error `xi = log(T_estimate^-1 T_true)`
in the LiDAR frame, NEES is `xi^T Sigma^-1 xi`, chi-square with six degrees of freedom if Sigma is correct:

- odometry: the motions T_prev_curr between consecutive scans, with the covariance of the odometry;
- registration: the motions between consecutive registered poses, T_world_prev^-1 T_world_curr, with
  `Sigma = Sigma_curr + Ad(T_curr_prev) Sigma_prev Ad(T_curr_prev)^T`. The errors of the two poses are assumed to be
  independent; the error of the map, which they share, cancels;
- pose: the registered poses relative to the first scan, where the world begins. Their errors include the drift of the
  map, which is not part of the covariance of a registration.

The median of NEES / 6 is 0.89 for a correct covariance and larger for one that is too small. The shares within 1, 2, 3
sigma, in %, should be 68.3, 95.4 and 99.7 (chi-square quantiles of these probabilities). Scans that are not `ok` are
left out and counted. At most `--scans` scans of a recording on disk are used. The ground truth of a real drive has
its own errors, which add to those of the estimate; the error of its first pose alone makes the rows of poses useless.
"""

from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
from mapping_accuracy import (
    DEFAULT_METHODS,
    METHODS,
    Recorded,
    add_simulation_arguments,
    make_parser,
    pipeline_results,
    print_header,
    print_row,
    recordings,
    true_trajectory,
)
from scipy.special import erf
from scipy.stats import chi2

from lidarslam.core.geometry import FloatArray, adjoint, inverse, log
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.odometry.config import OdometryConfig
from lidarslam.odometry.interface import Motion
from lidarslam.odometry.registry import make_odometry
from lidarslam.pipeline.estimates import ScanEstimate

_MAPPED = [name for name, config in METHODS.items() if config.mapping.enabled]
_DEFAULT = [name for name in DEFAULT_METHODS if name in _MAPPED]
# Numbers of standard deviations, and the expected share of errors within each.
SIGMAS = (1, 2, 3)
EXPECTED_SHARES = tuple(float(erf(sigma / np.sqrt(2.0))) for sigma in SIGMAS)


def estimated_motions(config: OdometryConfig, scans: Sequence[Scan]) -> list[Motion]:
    """Motions of an odometry alone."""
    with closing(make_odometry(config)) as odometry:
        return [odometry.estimate(scan) for scan in scans]


def squared_errors(covariances: Sequence[FloatArray | None], errors: FloatArray) -> FloatArray:
    """(N,) squared Mahalanobis norms of errors (N, 6); NaN without a covariance."""
    pairs = zip(covariances, errors, strict=True)
    return np.array([np.nan if sigma is None else error @ np.linalg.solve(sigma, error) for sigma, error in pairs])


def shares_within_sigmas(squared: FloatArray) -> list[float]:
    """Shares of squared errors (N,) within each of `SIGMAS`."""
    return [float(np.mean(squared <= chi2.ppf(share, 6))) for share in EXPECTED_SHARES]


def nees_of_poses(results: Sequence[ScanEstimate], truth: FloatArray) -> FloatArray:
    """(N,) of poses relative to the first, by ground truth (N, 4, 4); NaN without a covariance."""
    poses = np.array([result.T_world_lidar for result in results])
    errors = log(inverse(inverse(poses[0]) @ poses) @ inverse(truth[0]) @ truth)
    return squared_errors([result.covariance for result in results], errors)


def nees_of_registration(results: Sequence[ScanEstimate], truth: FloatArray) -> FloatArray:
    """(N-1,) of motions between consecutive poses, by ground truth (N, 4, 4); NaN without a covariance."""
    poses = np.array([result.T_world_lidar for result in results])
    motions = inverse(poses[:-1]) @ poses[1:]
    errors = log(inverse(motions) @ inverse(truth[:-1]) @ truth[1:])
    pairs = zip(results[:-1], results[1:], motions, strict=True)
    return squared_errors([motion_covariance(*pair) for pair in pairs], errors)


def motion_covariance(previous: ScanEstimate, current: ScanEstimate, T_prev_curr: FloatArray) -> FloatArray | None:
    """(6, 6) of the motion between two poses with independent errors; None if either has no covariance."""
    if previous.covariance is None or current.covariance is None:
        return None
    A = adjoint(inverse(T_prev_curr))
    return np.asarray(current.covariance + A @ previous.covariance @ A.T, dtype=np.float64)


def nees_of_odometry(recorded: Recorded, config: OdometryConfig, truth: FloatArray) -> FloatArray:
    """(N-1,) of an odometry's motions; NaN without a covariance or a measurement."""
    motions = estimated_motions(config, recorded.scans)[1:]
    errors = log(inverse(np.array([motion.T_prev_curr for motion in motions])) @ inverse(truth[:-1]) @ truth[1:])
    measured = [motion.covariance if motion.failure is None else None for motion in motions]
    return squared_errors(measured, errors)


def rows(recorded: Recorded, method: str) -> Iterator[list[str]]:
    """Rows of all kinds of estimates with covariances."""
    truth = true_trajectory(recorded).T_world_lidar
    results = pipeline_results(recorded.scans, METHODS[method])
    ok = np.array([result.status is Status.OK for result in results])
    kinds = {
        "odometry": (nees_of_odometry(recorded, METHODS[method].odometry, truth), np.ones(len(ok) - 1, bool)),
        "registration": (nees_of_registration(results, truth), ok[1:] & ok[:-1]),
        "pose": (nees_of_poses(results, truth)[1:], ok[1:]),
    }
    for kind, (nees, chosen) in kinds.items():
        known = nees[chosen & np.isfinite(nees)]
        if not len(known):
            continue
        counts = [str(len(known)), str(len(nees) - len(known))]
        shares = [f"{100.0 * share:.0f}" for share in shares_within_sigmas(known)]
        yield [recorded.name, method, kind, *counts, f"{np.median(known) / 6.0:.2f}", *shares]


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("sources", nargs="*", type=Path, help="recordings with ground truth")
    add_simulation_arguments(parser, motions=("car", "tracked"))
    parser.add_argument("--methods", nargs="+", choices=_MAPPED, default=_DEFAULT)
    options = parser.parse_args()
    header = ["recording", "method", "of", "count", "left out", "median NEES / 6"]
    header += [f"within {sigma} sigma, %" for sigma in SIGMAS]
    print_header(header)
    for recorded in recordings(options, options.scans):
        for method in options.methods:
            for cells in rows(recorded, method):
                print_row(cells)


if __name__ == "__main__":
    main()
