"""The elevation bias in a run: reported, corrected beforehand, and by a setting of any reader."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lidarslam.config.yaml_text import read_yaml
from lidarslam.core.geometry import exp
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.mounting import correct_elevation
from lidarslam.datasets.registry import open_recording

from ..conftest import succeeds
from .conftest import FAST, summary_of

LOW_DEG, SCANS = 0.4, 36
KEYS = ("elevation_bias_deg", "elevation_sigma_deg", "elevation_correction_deg")


@pytest.fixture(scope="module")
def low(tmp_path_factory: pytest.TempPathFactory, room: Any) -> Path:
    """A folder of scans, in a street, whose points all lie too low."""
    folder = tmp_path_factory.mktemp("elevation") / "street"
    folder.mkdir()
    pillars = tuple((x + side, 5.0 * side, 0.7) for x in range(-56, 56, 6) for side in (-1, 1))
    street = replace(room, half_size=(60.0, 9.0, 3.0), pillars=pillars, points=20_000)
    for number in range(SCANS):
        T = exp(np.array([0.0, 0.0, 0.0, -20.0 + 1.2 * number, 0.0, -1.0]))
        points = street.sweep(lambda times, T=T: np.tile(T, (len(times), 1, 1)), 0.1 * number).points  # type: ignore[misc]
        np.save(folder / f"{number:06d}.npy", correct_elevation(points, -LOW_DEG))
    return folder


@pytest.mark.long
def test_a_run_reports_the_bias_and_what_to_set(low: Path, tmp_path: Path) -> None:
    succeeds("run", low, "--out", tmp_path / "run", *FAST)
    found = summary_of(tmp_path / "run")
    bias_deg, sigma_deg, correction_deg = (found[key] for key in KEYS)
    assert bias_deg == pytest.approx(LOW_DEG, abs=0.08)
    assert abs(bias_deg - LOW_DEG) < 3.0 * sigma_deg
    assert correction_deg == 0.0
    assert any(f"reader.elevation_correction_deg={bias_deg:.2f}" in warning for warning in found["warnings"])


@pytest.mark.long
def test_corrected_beforehand(low: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    command = ("run", low, "--out", out, *FAST, "--set", "reader.elevation_correction_deg=auto")
    succeeds(*command)
    found = summary_of(out)
    correction_deg = found["elevation_correction_deg"]
    assert correction_deg == pytest.approx(LOW_DEG, abs=0.08)
    assert found["elevation_bias_deg"] == pytest.approx(LOW_DEG, abs=0.08)
    assert not any("elevation" in warning for warning in found["warnings"])
    # The run says what it used, and is still the one that was asked for.
    assert read_yaml(out / "config.yaml")["reader"]["elevation_correction_deg"] == correction_deg
    succeeds(*command, "--resume")


@pytest.mark.parametrize("mounting", ["upright", "upside-down"])
def test_any_reader_raises_points_above_the_recorded_plane(low: Path, mounting: str) -> None:
    config = ReaderConfig(mounting=mounting, elevation_correction_deg=0.0)  # type: ignore[arg-type]
    plain = next(open_recording(low, config).scans()).points
    raised = next(open_recording(low, config.model_copy(update={"elevation_correction_deg": 0.3})).scans()).points
    elevations = [np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])) for p in (plain, raised)]
    expected = 0.3 if mounting == "upright" else -0.3
    np.testing.assert_allclose(np.rad2deg(elevations[1] - elevations[0]), expected, atol=1e-9)
