"""Instants of the poses of peers of `lidarslam compare`, on scans in memory; each run is a separate process.

    python benchmarks/peers.py --peers ct-icp genz-icp --world office --motion handheld

Prints a Markdown table of the ATE in metres after SE(3) alignment on a simulated recording, with a row per peer. The
columns are shifts of the stamps before the comparison with the exact ground truth; where the instants are right, the
error is smallest at zero.
"""

import sys
from collections.abc import Iterable, Sequence
from concurrent.futures.process import BrokenProcessPool

from mapping_accuracy import in_process, make_parser, make_simulation, print_row

from lidarslam.compare.peers.estimation import PEERS, estimate
from lidarslam.compare.peers.interface import PeerError
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.evaluation.trajectory.metrics import evaluate_trajectory

SHIFTS_MS = (-100, -50, -25, 0, 25, 50, 100)
# Peers that need no IMU.
NAMES = tuple(name for name, peer in PEERS.items() if not peer.needs_imu)


def run_peer(name: str, scans: Iterable[Scan], imu: ImuSamples | None = None) -> Trajectory:
    """The trajectory of a peer at the scans' stamps.

    Raises:
        PeerError: it is not installed, its process ended early, or it has no usable poses.
    """
    PEERS[name].require(lambda: imu is not None)
    try:
        return in_process(_estimate, name, list(scans), imu)
    except BrokenProcessPool:
        raise PeerError("its process ended before the last scan") from None


def _estimate(name: str, scans: Sequence[Scan], imu: ImuSamples | None) -> Trajectory:
    return estimate(PEERS[name], scans, imu).trajectory


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--peers", nargs="+", choices=list(PEERS), default=list(PEERS))
    parser.add_argument("--world", default="street")
    parser.add_argument("--motion", default="car")
    parser.add_argument("--sensor", default="vlp-16")
    parser.add_argument("--scans", type=int, default=100)
    options = parser.parse_args()
    simulation = make_simulation(options.world, options.motion, options.sensor, options.scans, seed=0)
    scans = list(simulation.scans())
    print_row(["peer", *(f"{shift:+d} ms" for shift in SHIFTS_MS)])
    print_row(["---", *["---:"] * len(SHIFTS_MS)])
    for name in options.peers:
        try:
            found = run_peer(name, scans, simulation.imu)
        except PeerError as error:
            print(f"{name}: {error}", file=sys.stderr, flush=True)
            continue
        # The ground truth is exact within the recording.
        inside = found.select((found.stamps > 0.1) & (found.stamps < simulation.stamps[-1] - 0.1))
        truths = [simulation.ground_truth_at(inside.stamps + 1e-3 * shift).T_world_lidar for shift in SHIFTS_MS]
        errors = [evaluate_trajectory(inside, Trajectory(inside.stamps, truth)).errors for truth in truths]
        print_row([name, *(f"{error.ate_rmse_m:.3f}" for error in errors)])


if __name__ == "__main__":
    main()
