"""A peer's registration of scans from a file, timed after the first few, as JSON.

    python benchmarks/peer_loop.py mad-icp SCANS.npz 5

Its conversion of scans into types of its own is not timed, and so its processor time is not known.
"""

import json
import sys
from pathlib import Path

from pipeline_speed import saved_scans

from lidarslam.compare.peers.estimation import estimate
from lidarslam.compare.peers.registry import PEERS


def main() -> None:
    """Print wall seconds, and milliseconds of single scans."""
    peer, file, warm_up = PEERS[sys.argv[1]], Path(sys.argv[2]), int(sys.argv[3])
    scan_ms = list(estimate(peer, saved_scans(file)).register_ms.values())[warm_up:]
    print(json.dumps({"wall": sum(scan_ms) / 1e3, "processor": float("nan"), "scan_ms": scan_ms}))


if __name__ == "__main__":
    main()
