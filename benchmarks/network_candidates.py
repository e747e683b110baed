"""Accuracy of the network's candidates, before alignment, on real drives at several rates.

    python benchmarks/network_candidates.py DRIVE --weights base.safetensors tuned.safetensors --steps 1 3 5

Prints a Markdown table with a row per weights and step: errors of the best candidate's turn about z (median) and of its
translation in the plane (median, 95th percentile, largest), and how often the best candidate, or any, is right: within
4 degrees and 0.8 m, from where alignment converges. The reference is the trajectory of scan-to-map registration at
constant velocity and full rate, or with `--truth` the recording's ground truth.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from held_out import mapped, with_truth
from mapping_accuracy import Recorded, make_parser, print_header, print_row, true_trajectory

from lidarslam.core.geometry import FloatArray, inverse, log
from lidarslam.odometry.images.sweep_images import Imager
from lidarslam.odometry.network.candidates import Candidate
from lidarslam.odometry.network.checkpoint import load_checkpoint, network_of, torch_search

_RIGHT_DEG, _RIGHT_M = 4.0, 0.8


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("source", type=Path)
    parser.add_argument("--weights", type=Path, nargs="+", required=True)
    parser.add_argument("--steps", type=int, nargs="+", default=[1, 3, 5])
    parser.add_argument("--scans", type=int, default=60, help="maximum at each step")
    parser.add_argument("--truth", action="store_true", help="use the recording's ground truth as reference")
    options = parser.parse_args()
    recorded = with_truth(options.source) if options.truth else mapped(options.source)
    columns = ("recording", "every", "weights", "turn, deg: median", "translation, m: median", "95 %", "largest")
    print_header([*columns, "best right, %", "any right, %"])
    for step in options.steps:
        for weights in options.weights:
            found = _errors(recorded, step, options.scans, weights)
            print_row([recorded.name, str(step), weights.stem, *_cells(found)])


def _errors(recorded: Recorded, step: int, most: int, weights: Path) -> list[FloatArray]:
    """Errors (K, 2) of the candidates of each pair, best first, in degrees and metres."""
    checkpoint = load_checkpoint(weights)
    imager, search = Imager(checkpoint.images), torch_search(network_of(checkpoint))
    poses = true_trajectory(recorded).T_world_lidar[::step][:most]
    found, before = [], None
    for number, scan in enumerate(recorded.scans[::step][:most]):
        shown = imager.images(scan).network
        if before is None:
            before = search.describe(shown.points, shown.normals)
            continue
        candidates, before = search.compare(before, shown.points, shown.normals)
        motion = inverse(poses[number - 1]) @ poses[number]
        found.append(np.array([_error(candidate, motion) for candidate in candidates]))
    return found


def _error(candidate: Candidate, motion: FloatArray) -> tuple[float, float]:
    turn = log(candidate.T_prev_curr @ inverse(motion))[2]
    away = candidate.T_prev_curr[:2, 3] - motion[:2, 3]
    return abs(float(np.rad2deg(turn))), float(np.linalg.norm(away))


def _cells(found: Sequence[FloatArray]) -> list[str]:
    best = np.array([errors[0] for errors in found])
    right = [np.all(errors < (_RIGHT_DEG, _RIGHT_M), axis=1, keepdims=True) for errors in found]
    shares = [np.mean([one[0, 0] for one in right]), np.mean([one.any() for one in right])]
    metres = [np.median(best[:, 1]), np.percentile(best[:, 1], 95.0), best[:, 1].max()]
    return [f"{np.median(best[:, 0]):.2f}", *(f"{m:.2f}" for m in metres), *(f"{100.0 * s:.0f}" for s in shares)]


if __name__ == "__main__":
    main()
