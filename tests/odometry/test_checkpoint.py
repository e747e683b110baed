"""Weights on disk: what is written comes back, and what is no such file is refused in one line."""

import pytest
import torch
from safetensors.torch import save_file

from lidarslam.core.errors import InputError
from lidarslam.odometry.config import ImageConfig, NetworkConfig
from lidarslam.odometry.network.checkpoint import (
    Checkpoint,
    Kind,
    checkpoint_of,
    load_checkpoint,
    network_of,
    save_checkpoint,
    write_tensor_file,
)
from lidarslam.odometry.network.networks import make_network


@pytest.fixture(scope="module")
def trained() -> Checkpoint:
    config = NetworkConfig()
    torch.manual_seed(3)
    about = {"steps": 7, "sources": ["office"]}
    return checkpoint_of(make_network(config), config, ImageConfig(rows=16, columns=96), about)


def test_what_is_saved_comes_back(trained, tmp_path):
    save_checkpoint(tmp_path / "weights.safetensors", trained)
    loaded = load_checkpoint(tmp_path / "weights.safetensors")
    assert (loaded.network, loaded.images, loaded.about) == (trained.network, trained.images, trained.about)
    points = 5.0 * torch.randn(2, 3, 16, 96)
    networks = [network_of(one) for one in (trained, loaded)]
    assert not any(network.training for network in networks)
    with torch.no_grad():
        one, other = (network.columns(points, torch.zeros_like(points)) for network in networks)
    assert torch.equal(one, other)


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda _, __: None, "no such file"),
        (lambda path, _: path.write_text("some notes that are long enough"), "is no safetensors file"),
        (lambda path, _: path.mkdir(), "is no safetensors file"),
        (lambda path, weights: save_file(weights, path), "holds tensors of another program, not weights"),
        (
            lambda path, weights: write_tensor_file(path, Kind("the state of a training", 1), weights, {}),
            "holds the state of a training, not weights",
        ),
        (
            lambda path, weights: write_tensor_file(path, Kind("weights", 99), weights, {}),
            "version 99, this program reads 1 at most; use a newer",
        ),
    ],
)
def test_other_files_kinds_and_versions_are_told(trained, tmp_path, make, told):
    make(tmp_path / "weights.safetensors", trained.weights)
    with pytest.raises(InputError, match=told):
        load_checkpoint(tmp_path / "weights.safetensors")
