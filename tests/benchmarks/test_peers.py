"""Peers on scans in memory, for benchmarks."""

import numpy as np
import pytest
from peers import NAMES, run_peer

from lidarslam.compare.peers.estimation import PEERS
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory


def test_benchmarks_have_the_peers_that_need_no_imu() -> None:
    assert "ct-icp" in NAMES
    assert not any(PEERS[name].needs_imu for name in NAMES)


@pytest.mark.long
def test_a_peer_runs_in_a_process_of_its_own(room_scans: list[Scan], room_truth: Trajectory) -> None:
    pytest.importorskip("small_gicp", reason="needs the extra peers")
    found = run_peer("small-gicp", room_scans[:5])
    np.testing.assert_allclose(found.stamps, room_truth.stamps[:5])
