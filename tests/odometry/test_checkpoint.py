"""Weights on disk: what is written comes back, and what is no such file is refused in one line."""

import os
import pickle
from dataclasses import replace

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

BIAS = "columns.layers.8.bias"


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


class Trap:
    """Makes a folder when it is unpickled."""

    def __reduce__(self):
        return os.mkdir, ("trap",)


@pytest.mark.parametrize(
    "save", [lambda path: path.write_bytes(pickle.dumps(Trap())), lambda path: torch.save({"weight": Trap()}, path)]
)
def test_a_pickle_is_refused_unopened(save, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save(tmp_path / "weights.pt")
    with pytest.raises(InputError, match="is no safetensors file"):
        load_checkpoint(tmp_path / "weights.pt")
    assert not (tmp_path / "trap").exists()


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda _, __: None, "no such file"),
        (lambda path, _: path.write_text("some notes that are long enough"), "is no safetensors file"),
        (lambda path, _: path.mkdir(), "is no safetensors file"),
        (lambda path, weights: save_file(weights, path), "holds no weights"),
        (lambda path, weights: write_tensor_file(path, Kind("a training", 1), weights, {}), "holds no weights"),
        (lambda path, weights: write_tensor_file(path, Kind("weights", 99), weights, {}), "version 99, .* use a newer"),
    ],
)
def test_other_files_kinds_and_versions_are_told(trained, tmp_path, make, told):
    make(tmp_path / "weights.safetensors", trained.weights)
    with pytest.raises(InputError, match=told):
        load_checkpoint(tmp_path / "weights.safetensors")


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({BIAS: None}, r"Missing key.*columns\.layers\.8\.bias"),
        ({BIAS: torch.zeros(5)}, r"size mismatch for columns\.layers\.8\.bias"),
        ({BIAS: torch.full((32,), torch.nan)}, r"columns\.layers\.8\.bias is torch.float32, or not finite"),
        ({"surplus": torch.zeros(1)}, r"Unexpected key.*surplus"),
    ],
)
def test_weights_that_do_not_fit_are_told(trained, tmp_path, changed, told):
    weights = {name: value for name, value in {**trained.weights, **changed}.items() if value is not None}
    save_checkpoint(tmp_path / "weights.safetensors", replace(trained, weights=weights))
    with pytest.raises(InputError, match=told):
        load_checkpoint(tmp_path / "weights.safetensors")
