"""Points' times on another scale, which bend every sweep alike, show in how fast the sensor turns within the sweeps."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import FloatArray
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.registry import open_recording
from lidarslam.run.calibration import time_scale, time_scale_warning

from ..conftest import lidarslam, succeeds

STAMPS = 100.0 + 0.1 * np.arange(60)


def turning(rates: FloatArray, interval_s: float = 0.1) -> Trajectory:
    """A sensor that turns about z at rates (N,) rad/s."""
    poses = np.tile(np.eye(4), (len(rates), 1, 1))
    angles = np.concatenate([[0.0], np.cumsum(interval_s * rates[:-1])])
    poses[:, :3, :3] = Rotation.from_euler("z", angles[:, None]).as_matrix()
    return Trajectory(100.0 + interval_s * np.arange(len(rates)), poses)


@pytest.mark.parametrize(
    ("ratio", "fault"), [(1.0, None), (0.8, None), (0.5, "too long"), (2.0, "too short"), (-0.6, "backwards")]
)
def test_the_ratio_of_the_turn_rates_is_that_of_the_times(ratio: float, fault: str | None) -> None:
    rates = 0.5 * np.sin(STAMPS)
    found = time_scale(turning(rates), ratio * np.outer(rates, [0.0, 0.0, 1.0]), np.full(60, True))
    assert found is not None
    assert found[0] == pytest.approx(ratio, rel=0.01)
    warning = time_scale_warning(found)
    assert (warning is None) == (fault is None)
    assert warning is None or f"times are {fault}" in warning


def test_few_turns_lost_scans_and_long_intervals_decide_nothing() -> None:
    rates, tracked = np.full(60, 0.5), np.full(60, True)
    within = 0.5 * np.outer(rates, [0.0, 0.0, 1.0])
    assert time_scale(turning(rates), within, tracked) is not None
    assert time_scale(turning(0.1 * rates), 0.1 * within, tracked) is None
    assert time_scale(turning(rates), within, ~tracked) is None
    assert time_scale(turning(rates), np.full((60, 3), np.nan), tracked) is None
    assert time_scale(turning(rates, 0.5), within, tracked) is None
    assert time_scale_warning(None) is None


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("time_scale") / "walk"
    succeeds("simulate", "-o", out, "--scans", 40, "--world", "hall", "--motion", "handheld", "--format", "mcap")
    return out


@pytest.mark.long
@pytest.mark.parametrize(("scale", "fault"), [(1.0, None), (2.0, "too long"), (-1.0, "backwards")])
def test_a_run_says_that_the_times_are_wrong(walk: Path, tmp_path: Path, scale: float, fault: str | None) -> None:
    options = ["--odometry", "constant-velocity", "--no-report", "--set", f"reader.time_scale={scale}"]
    out = tmp_path / "run"
    lidarslam("run", walk, "--out", out, *options)
    warnings = [text for text in json.loads((out / "summary.json").read_text())["warnings"] if "points' times" in text]
    assert len(warnings) == (fault is not None)
    assert all(f"times are {fault}" in text for text in warnings)


@pytest.mark.long
@pytest.mark.parametrize("mounting", ["auto", "upright", "left"])
def test_the_scale_holds_for_any_mounting(walk: Path, mounting: str) -> None:
    configs = (ReaderConfig.model_validate({"mounting": mounting, "time_scale": scale}) for scale in (1.0, -0.5))
    (recorded,), (scaled,) = (list(open_recording(walk, config).scans(stop=1)) for config in configs)
    assert recorded.time_offsets is not None
    np.testing.assert_array_equal(scaled.time_offsets, -0.5 * recorded.time_offsets)
