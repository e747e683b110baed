"""Peers in a comparison: poses at the scans' stamps, rows for those that cannot run."""

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from lidarslam.compare.peers.estimation import PEERS, estimate, is_covered
from lidarslam.compare.peers.interface import PeerError, Poses, Sweep
from lidarslam.compare.plan import scene_range_m
from lidarslam.core.geometry import FloatArray, exp
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.evaluation.trajectory.metrics import evaluate_trajectory

from ...conftest import succeeds
from ..conftest import summary_of

SWEEP_S = 0.1
SLOWEST = pytest.param("ct-icp", marks=pytest.mark.slow)


def _at(seconds: float) -> FloatArray:
    """A motion whose speed and turn rate change."""
    return exp(np.array([0.0, 0.0, 0.3, 1.0, 0.2, 0.0]) * seconds * (1.0 + seconds))


class _Exact:
    """A peer without errors, whose poses belong to the ends of the sweeps."""

    def __init__(self) -> None:
        self.samples: list[int] = []
        self.instants: list[float] = []
        self.ends_at_samples: list[int] = []

    def add_imu(self, _: ImuSamples, number: int) -> None:
        self.samples.append(number)

    def load(self, sweep: Sweep) -> Callable[[], None]:
        return lambda: (self.instants.append(sweep.end), self.ends_at_samples.append(len(self.samples)))[0]

    def finish(self) -> Poses:
        return Poses(np.array(self.instants), np.array([_at(instant) for instant in self.instants]))


def _scans(count: int, empty: tuple[int, ...] = ()) -> list[Scan]:
    points, offsets = np.random.default_rng(0).uniform(1.0, 9.0, (50, 3)), np.linspace(0.0, SWEEP_S, 50)
    sizes = [0 if number in empty else 50 for number in range(count)]
    return [Scan(points[:size], SWEEP_S * n, offsets[:size]) for n, size in enumerate(sizes)]


def _peer(exact: _Exact, needs_imu: bool = False) -> "replace":
    return replace(PEERS["small-gicp"], library="numpy", make=lambda *_: exact, needs_imu=needs_imu)


def test_poses_are_interpolated_at_the_stamps_and_an_empty_scan_is_not_registered():
    found = estimate(_peer(_Exact()), _scans(8, empty=(3,)))
    np.testing.assert_allclose(found.trajectory.stamps, SWEEP_S * np.arange(8))
    expected = np.array([_at(stamp) for stamp in found.trajectory.stamps])
    np.testing.assert_allclose(found.trajectory.T_world_lidar[1:, :3, 3], expected[1:, :3, 3], atol=0.01)
    assert len(found.register_ms) == 7


def test_samples_of_the_imu_come_before_the_end_of_each_sweep_once_and_in_order():
    exact = _Exact()
    stamps = np.arange(-5, 100) * 0.01 + 0.005
    samples = ImuSamples(stamps, np.zeros((105, 3)), np.zeros((105, 3)))
    estimate(_peer(exact, needs_imu=True), _scans(4), samples)
    assert exact.samples == list(range(45))
    assert exact.ends_at_samples == [15, 25, 35, 45]


def test_scans_in_a_gap_or_far_outside_the_poses_have_none():
    instants = np.array([0.0, 3.0, 3.1, 3.2, 3.3])
    stamps = np.array([-1.0, 0.0, 1.5, 2.9, 3.0, 3.35, 3.5, 4.0])
    np.testing.assert_array_equal(is_covered(instants, stamps), [False, False, False, False, True, True, True, False])


def test_poses_that_are_none_are_an_error():
    exact = _Exact()
    exact.finish = lambda: Poses(np.arange(2.0), np.full((2, 4, 4), np.nan))
    with pytest.raises(PeerError, match="not finite"):
        estimate(_peer(exact), _scans(3))


def test_ct_icps_poses_stand_at_the_starts_but_for_the_first_and_the_second():
    pytest.importorskip("evalio", reason="needs the extra peers")
    from lidarslam.compare.peers.evalio_pipelines import elastic_instants

    starts = np.array([1.0, 1.1, 1.2, 1.3])
    rows, instants = elastic_instants(starts, starts + 0.05, starts + 0.1)
    assert rows.tolist() == [0, 2, 3]
    np.testing.assert_allclose(instants, [1.05, 1.2, 1.3])
    rows, instants = elastic_instants(starts, starts, starts)
    assert rows.tolist() == [1, 2, 3, 4]
    np.testing.assert_allclose(instants, starts)


def _swaying(time: FloatArray) -> FloatArray:
    """A motion to and fro, which an error of half a sweep in the instants cannot hide in."""
    time = np.asarray(time)[..., None]
    still = np.zeros_like(time)
    turn, x, y = 0.2 * np.sin(3.0 * time), 0.6 * np.sin(2.5 * time), 0.3 * np.cos(3.5 * time)
    return exp(np.concatenate([still, still, turn, x, y, still], axis=-1))


# Feature-based pipelines want rings, which the room does not have.
@pytest.mark.parametrize("name", ["kiss-icp-evalio", "genz-icp", "mad-icp", SLOWEST, "kiss-slam", "small-gicp"])
def test_the_poses_fit_the_truth_best_at_the_scans_own_stamps(name, room):
    pytest.importorskip(PEERS[name].library, reason="needs the extra peers")
    stamps = SWEEP_S * np.arange(1, 26)
    found = estimate(PEERS[name], (room.sweep(_swaying, float(stamp)) for stamp in stamps)).trajectory

    def error_m(shift_s: float) -> float:
        truth = Trajectory(found.stamps, _swaying(found.stamps + shift_s))
        return evaluate_trajectory(found, truth).errors.ate_rmse_m

    assert error_m(0.0) < min(error_m(-0.5 * SWEEP_S), error_m(0.5 * SWEEP_S))


@pytest.mark.long
def test_a_peer_is_a_row_with_a_map_and_one_that_cannot_run_is_a_row_too(recording, tmp_path):
    pytest.importorskip("small_gicp", reason="needs the extra peers")
    out = tmp_path / "compared"
    arguments = ["compare", recording, "-o", out, "--methods", "small-gicp,rko-lio"]
    succeeds(*arguments)
    methods = json.loads((out / "comparison.json").read_text())["methods"]
    assert methods["small-gicp"]["status"] == "ok"
    assert methods["small-gicp"]["metrics"]["trajectory"]["ate_rmse_m"] < 0.1
    assert methods["rko-lio"]["status"] == "not run"
    assert "IMU" in methods["rko-lio"]["message"] or "not installed" in methods["rko-lio"]["message"]
    run = out / "room" / "small-gicp"
    assert (run / "map.ply").is_file()
    assert "peer: small_gicp" in (run / "config.yaml").read_text()
    assert summary_of(run)["scans"] == 5
    again = succeeds(*arguments, "--reuse")
    assert "small-gicp: ok" in again
    assert "in an earlier comparison" in again


class _Ranges:
    """A recording whose points lie up to 7 m away, and one in two hundred in 60 m; from the eleventh scan on, 90 m."""

    def __init__(self, scale: float) -> None:
        self._scale = scale

    def scans(self, start: int, stop: int, step: int, _: object) -> list[Scan]:
        ranges = np.r_[np.linspace(1.0, 7.0, 199), 60.0]
        far = np.full(200, 90.0)
        points = [np.outer(far if number > 9 else ranges, [self._scale, 0.0, 0.0]) for number in range(30)]
        return [Scan(points[number], float(number)) for number in range(start, stop, step)]


def test_the_range_of_a_scene_is_twice_that_of_nearly_all_points_of_the_first_scans_and_outdoors_the_default():
    ranges = {scale: scene_range_m(_Ranges(scale), range(30)) for scale in (1.0, 0.1, 8.0)}
    assert ranges[1.0] == pytest.approx(14.0, abs=0.2)
    assert (ranges[0.1], ranges[8.0]) == (10.0, 100.0)
    assert scene_range_m(_Ranges(1.0), range(10, 30)) == 100.0
    assert scene_range_m(_Ranges(1.0), range(0)) == 100.0


@pytest.mark.slow
def test_scene_behind_a_name_is_a_second_row_whose_run_has_the_range(recording, tmp_path):
    pytest.importorskip("small_gicp", reason="needs the extra peers")
    out = tmp_path / "compared"
    names = ["small-gicp", "small-gicp@scene", "kiss-icp@scene"]
    arguments = ["compare", recording, "-o", out, "--methods", ",".join(names)]
    said = succeeds(*arguments)
    content = json.loads((out / "comparison.json").read_text())
    assert [method["status"] for method in content["methods"].values()] == ["ok"] * 3
    assert all(method["metrics"]["trajectory"]["ate_rmse_m"] < 0.1 for method in content["methods"].values())
    (note,) = (note for note in content["notes"] if note.startswith("@scene: maximum range "))
    range_m = float(note.split()[3])
    assert 10.0 <= range_m < 40.0
    configs = {name: (out / "room" / name / "config.yaml").read_text() for name in names}
    assert "max_range_m: 100.0" in configs["small-gicp"]
    assert [f"max_range_m: {range_m}" in configs[name] for name in names] == [False, True, True]
    assert "Times of small-gicp, small-gicp@scene: registration alone" in said
    assert succeeds(*arguments, "--reuse").count("in an earlier comparison") == 3


@pytest.mark.parametrize(
    "name",
    [SLOWEST if name == "ct-icp" else name for name, peer in PEERS.items() if peer.has_voxels and not peer.needs_imu],
)
def test_every_peer_with_voxels_registers_a_small_scene_with_fine_ones(name, room):
    pytest.importorskip(PEERS[name].library, reason="needs the extra peers")
    sweeps = [room.sweep(_swaying, SWEEP_S * number) for number in range(1, 7)]
    coarse, fine = (estimate(PEERS[name], sweeps, range_m=range_m).trajectory for range_m in (None, 20.0))
    assert len(fine) == len(coarse)
    assert np.abs(fine.T_world_lidar - coarse.T_world_lidar).max() > 1e-6
