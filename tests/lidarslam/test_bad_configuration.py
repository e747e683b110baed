"""Configurations, weights and trajectories that are not what they should be: one line, exit status 1, nothing run."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lidarslam.odometry.config import ImageConfig, NetworkConfig
from lidarslam.odometry.network.checkpoint import checkpoint_of, save_checkpoint
from lidarslam.odometry.network.networks import make_network

from ..conftest import lidarslam
from .conftest import refused, summary_of

_PAIRS = zip("abcdefgh", "bcdefghi", strict=True)
LAUGHS = "a: &a [x]\n" + "".join(f"{c}: &{c} [{', '.join(['*' + b] * 9)}]\n" for b, c in _PAIRS)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("odometry: {kiss_icp: {voxel_size: 1}}", "no odometry.kiss_icp.voxel_size; did you mean voxel_size_m?"),
        ("odometry: {kiss_icp: {voxel_size_m: [1]}}", "voxel_size_m=[1]: "),
        (LAUGHS + "mapping: *i\n", "mapping=["),
        ("odometry: &a\n  kiss_icp: *a\n", "there is no odometry.kiss_icp.kiss_icp"),
        ("odometry: {kiss_icp: {voxel_size_m: '" + "x" * 100_000 + "'}}", "xxx...xxx"),
        ('"odo\\e[31m\\nmetry": 1', "there is no odo\\x1b[31m\\nmetry"),
    ],
    ids=range(6),
)
def test_a_bad_configuration_file(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "config.yaml").write_text(text)
    said = refused("config", "--config", tmp_path / "config.yaml")
    assert message in said
    assert "config.yaml" in said
    assert len(said) < 2_200
    assert said.strip().isprintable()


def test_weights_whose_answers_are_no_numbers_lose_the_way_but_end_well(tmp_path: Path, small_recording: Path) -> None:
    network = NetworkConfig()
    trained = checkpoint_of(make_network(network), network, ImageConfig(columns=180))
    weights = {key: 1e30 * value if value.is_floating_point() else value for key, value in trained.weights.items()}
    save_checkpoint(tmp_path / "w.safetensors", replace(trained, weights=weights))
    command = ("run", small_recording, "--weights", tmp_path / "w.safetensors")
    result = lidarslam(*command, "--out", tmp_path / "run", "--no-mapping")
    assert result.exit_code == 3
    assert "not a motion; try other weights" in result.stdout


def _edited(table: np.ndarray, name: str) -> str:
    if name == "NaN":
        table[2, 2] = np.nan
    if name == "light years":
        table[:, 1:4] *= 1e200
    if name == "one pose":
        table = table[:1]
    if name == "one stamp":
        table[:, 0] = 0.3
    if name == "another time":
        table[:, 0] += 1_000.0
    return "\n".join(" ".join(f"{value:.9f}" for value in row) for row in table)


BAD_TRAJECTORIES = {
    "NaN": "holds numbers that are no poses",
    "light years": "expected metres",
    "one pose": "two poses or more",
    "one stamp": "two poses or more",
    "another time": "is it of this recording",
}


@pytest.mark.parametrize("name", BAD_TRAJECTORIES)
def test_a_prior_that_is_none(tmp_path: Path, small_recording: Path, name: str) -> None:
    (tmp_path / "bad.tum").write_text(_edited(np.loadtxt(small_recording / "ground_truth.tum"), name))
    said = refused("run", small_recording, "--out", tmp_path / "new", "--prior", tmp_path / "bad.tum")
    assert BAD_TRAJECTORIES[name] in said
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("name", "message"), [("NaN", BAD_TRAJECTORIES["NaN"]), ("one pose", "one of them is too short")]
)
def test_a_reference_that_is_none(
    tmp_path: Path, small_recording: Path, finished_run: Path, name: str, message: str
) -> None:
    (tmp_path / "bad.tum").write_text(_edited(np.loadtxt(small_recording / "ground_truth.tum"), name))
    before = (finished_run / "metrics.json").read_text()
    assert message in refused("evaluate", finished_run, "--reference", tmp_path / "bad.tum")
    assert (finished_run / "metrics.json").read_text() == before


@pytest.mark.parametrize("mapping", ["off", "surfels"])
def test_scans_without_a_prior_are_counted_and_without_a_mapping_lost(
    tmp_path: Path, small_recording: Path, mapping: str
) -> None:
    out, late = tmp_path / "run", np.loadtxt(small_recording / "ground_truth.tum")
    late[:, 0] += 0.25
    np.savetxt(tmp_path / "late.tum", late, fmt="%.9f")
    result = lidarslam(
        "run", small_recording, "--out", out, "--prior", tmp_path / "late.tum", "--mapping", mapping, "--no-report"
    )
    assert "the prior does not cover 2 of 6 scans" in summary_of(out)["warnings"]
    if mapping == "off":
        assert result.exit_code == 3
        assert "the prior does not cover this scan" in result.stdout
        assert summary_of(out)["lost_scans"] == 2
