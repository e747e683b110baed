"""Configurations, weights and trajectories that are not what they should be: one line, exit status 1, nothing run."""

from dataclasses import replace

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
        ("odometry: {kiss_icp: {voxel_size_m: [1]}}", "voxel_size_m=[1]: "),
        (LAUGHS + "mapping: *i\n", "mapping=["),
        ("odometry: &a\n  kiss_icp: *a\n", "there is no odometry.kiss_icp.kiss_icp"),
        ("odometry: {kiss_icp: {voxel_size_m: '" + "x" * 100_000 + "'}}", "xxx...xxx"),
        ('"odo\\e[31m\\nmetry": 1', "there is no odo\\x1b[31m\\nmetry"),
    ],
    ids=range(5),
)
def test_a_bad_configuration_file(tmp_path, text, message):
    (tmp_path / "config.yaml").write_text(text)
    said = refused("config", "--config", tmp_path / "config.yaml")
    assert message in said
    assert "config.yaml" in said
    assert len(said) < 2_200
    assert said.strip().isprintable()


def test_weights_whose_answers_are_no_numbers_lose_the_way_but_end_well(tmp_path, small_recording):
    network = NetworkConfig()
    trained = checkpoint_of(make_network(network), network, ImageConfig(columns=180))
    weights = {key: 1e30 * value if value.is_floating_point() else value for key, value in trained.weights.items()}
    save_checkpoint(tmp_path / "w.safetensors", replace(trained, weights=weights))
    command = ("run", small_recording, "--weights", tmp_path / "w.safetensors")
    result = lidarslam(*command, "--out", tmp_path / "run", "--no-mapping")
    assert result.exit_code == 3
    assert "not a motion; try other weights" in result.stdout


@pytest.mark.parametrize(
    ("scale", "later_s", "message"),
    [(1e200, 0.0, "expected metres"), (1.0, 1_000.0, "is it of this recording"), (np.nan, 0.0, "that are no poses")],
)
def test_a_prior_that_is_none(tmp_path, small_recording, scale, later_s, message):
    table = np.loadtxt(small_recording / "ground_truth.tum")
    np.savetxt(tmp_path / "bad.tum", table * [1.0, scale, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0] + np.eye(8)[0] * later_s)
    said = refused("run", small_recording, "--out", tmp_path / "new", "--prior", tmp_path / "bad.tum")
    assert message in said
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("mapping", ["off", "surfels"])
def test_scans_without_a_prior_are_counted_and_without_a_mapping_lost(tmp_path, small_recording, mapping):
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
