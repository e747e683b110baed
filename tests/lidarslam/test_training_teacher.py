"""What teaches a network, and how often it is drawn."""

from pathlib import Path

import numpy as np
import pytest
import torch

from lidarslam.core.geometry import inverse, log
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.odometry.config import ImageConfig
from lidarslam.odometry.training.preparation import prepare
from lidarslam.simulation.record import RecordRequest, make_simulation
from lidarslam.train.data import MapTeacher, Stretch, draw_weights

SCANS = 14


@pytest.fixture(scope="module")
def drive() -> tuple[list[Scan], Trajectory]:
    """A car that is at speed from the first scan on, half a metre from scan to scan."""
    request = RecordRequest(Path(), "street", "vlp-16", "car-fast", "upright", SCANS, 5, "", speed_mps=6.0)
    simulation = make_simulation(request)
    return list(simulation.scans()), simulation.ground_truth


@pytest.mark.long
def test_the_map_teaches_the_true_motions_between_the_middles_of_sweeps(drive):
    scans, truth = drive
    teacher = MapTeacher()
    for scan in scans:
        teacher.follow(scan)
    taught = teacher.relabelled(prepare(iter(scans), ImageConfig()))
    middles = np.array([scan.stamp + scan.middle_offset_s for scan in scans[:-1]])
    poses = truth.at(middles, 0.1)
    expected = inverse(poses[:-1]) @ poses[1:]
    sure = taught.valid.numpy()[: SCANS - 2]
    assert sure.mean() > 0.7
    errors = log(inverse(taught.T_prev_curr.double().numpy()[: SCANS - 2]) @ expected)[sure]
    assert np.linalg.norm(errors[:, 3:], axis=1).max() < 0.05
    assert np.rad2deg(np.linalg.norm(errors[:, :3], axis=1)).max() < 0.3
    assert np.linalg.norm(expected[:, :3, 3], axis=1).min() > 0.4


def test_what_is_not_sure_is_not_taught(drive):
    scans, _ = drive
    teacher = MapTeacher()
    strange = [*scans[:5], Scan(scans[5].points[:40], scans[5].stamp), *scans[6:9]]
    for scan in strange:
        teacher.follow(scan)
    taught = teacher.relabelled(prepare(iter(strange), ImageConfig()))
    assert taught.valid.dtype == torch.bool
    assert not taught.valid[4]
    assert not taught.valid[5]


def stretch(scans: int, simulated: bool) -> Stretch:
    identity = {"simulated": 1} if simulated else {"source": "somewhere"}
    return Stretch("some", identity, lambda: pytest.fail("opened"), 0, scans)


@pytest.mark.parametrize(
    ("recorded", "simulated", "weights"),
    [
        ([100, 300], [40, 40, 40], [0.075, 0.225, 0.7 / 3, 0.7 / 3, 0.7 / 3]),
        ([1200], [40], [0.1, 0.1, 0.1, 0.7]),
        ([10, 400], [], [1.0, 1.0]),
        ([], [10, 400], [1.0, 1.0]),
    ],
)
def test_recordings_have_their_share_of_the_pairs_by_their_lengths_and_long_ones_are_drawn_in_pieces(
    recorded, simulated, weights
):
    given = [*(stretch(scans, False) for scans in recorded), *(stretch(scans, True) for scans in simulated)]
    assert draw_weights(given) == pytest.approx(weights)
