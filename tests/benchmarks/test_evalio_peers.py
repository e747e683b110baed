"""At which instants the peers' poses stand."""

import importlib.util

import evalio_peers
import numpy as np
import pytest
from evalio_peers import PEERS, PeerError, pose_instants, run_peer

from lidarslam.core.geometry import exp
from lidarslam.core.scan import Scan

STAMPS = np.array([1.0, 1.1, 1.2, 1.3])


def test_a_peer_that_does_not_compensate_motion_stands_at_the_middle_of_the_sweep() -> None:
    rows, instants = pose_instants(False, STAMPS, STAMPS - 0.02, STAMPS + 0.08)
    assert rows == [0, 1, 2, 3]
    np.testing.assert_allclose(instants, STAMPS + 0.03)


def test_an_elastic_peer_stands_at_the_start_of_the_sweep_but_for_the_first_and_the_second_scan() -> None:
    rows, instants = pose_instants(True, STAMPS, STAMPS - 0.02, STAMPS + 0.08)
    assert rows == [0, 2, 3]
    np.testing.assert_allclose(instants, [1.03, 1.18, 1.28])


def test_an_elastic_peer_is_a_scan_behind_on_compensated_scans() -> None:
    rows, instants = pose_instants(True, STAMPS, STAMPS, STAMPS)
    assert rows == [1, 2, 3, 4]
    np.testing.assert_allclose(instants, STAMPS)


def test_without_evalio_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evalio_peers.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(PeerError, match=r"pip install 'lidarslam\[benchmarks\]'"):
        run_peer("CT-ICP", [])


@pytest.mark.skipif(importlib.util.find_spec("evalio") is None, reason="needs evalio: pip install '.[benchmarks]'")
@pytest.mark.parametrize("name", [name for name, peer in PEERS.items() if peer.is_elastic])
def test_compensated_scans_of_a_box_come_out_at_their_own_stamps(name: str) -> None:
    rng = np.random.default_rng(0)
    walls = rng.uniform(-10.0, 10.0, (6000, 3))
    walls[np.arange(6000), np.arange(6000) % 3] = np.where(np.arange(6000) % 2, 10.0, -10.0)
    poses = exp(np.arange(5)[:, None] * np.array([0.0, 0.0, 0.01, 0.1, 0.0, 0.0]))
    scans = [
        Scan((walls - pose[:3, 3]) @ pose[:3, :3], 0.1 * number)  # the inverse of the pose
        for number, pose in enumerate(poses)
    ]
    found = run_peer(name, scans)
    np.testing.assert_allclose(found.stamps, [scan.stamp for scan in scans])
    np.testing.assert_allclose(found.T_world_lidar[:, :3, 3], poses[:, :3, 3], atol=0.03)
