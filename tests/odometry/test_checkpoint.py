"""Weights on disk: what is written comes back, and what is no such file is refused in one line."""

import os
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

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

IMAGES = ImageConfig(rows=16, columns=96)


@pytest.fixture
def trained() -> Checkpoint:
    config = NetworkConfig()
    torch.manual_seed(3)
    return checkpoint_of(make_network(config), config, IMAGES, {"steps": 7, "sources": ["office"]})


@pytest.fixture
def file(trained: Checkpoint, tmp_path: Path) -> Path:
    save_checkpoint(tmp_path / "weights.safetensors", trained)
    return tmp_path / "weights.safetensors"


def test_what_is_saved_comes_back(trained: Checkpoint, file: Path) -> None:
    loaded = load_checkpoint(file)
    assert (loaded.network, loaded.images, loaded.about) == (trained.network, trained.images, trained.about)
    points = 5.0 * torch.randn(2, 3, 16, 96)
    with torch.no_grad():
        results = []
        for one in (trained, loaded):
            network = network_of(one)
            assert not network.training
            results.append(network.columns(points, torch.zeros_like(points)))
    assert torch.equal(results[0], results[1])


class _Malicious:
    """Makes a folder when it is unpickled."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[Callable[[str], None], tuple[str]]:
        return os.mkdir, (str(self.trace),)


@pytest.mark.parametrize("how", ["pickle", "archive"])
def test_a_pickle_is_refused_unopened(how: str, tmp_path: Path) -> None:
    path, trace = tmp_path / "weights.pt", tmp_path / "trace"
    if how == "pickle":
        path.write_bytes(pickle.dumps(_Malicious(trace)))
    else:
        torch.save({"weight": _Malicious(trace)}, path)
    with pytest.raises(InputError, match="is no safetensors file"):
        load_checkpoint(path)
    assert not trace.exists()


def test_what_is_no_weights_file_is_told(tmp_path: Path, trained: Checkpoint) -> None:
    missing = tmp_path / "missing.safetensors"
    with pytest.raises(InputError, match="no such file"):
        load_checkpoint(missing)
    text = tmp_path / "notes.txt"
    text.write_text("some notes that are long enough")
    with pytest.raises(InputError, match="is no safetensors file"):
        load_checkpoint(text)
    other = tmp_path / "other.safetensors"
    save_file(trained.weights, other)
    with pytest.raises(InputError, match="holds tensors of another program, not weights"):
        load_checkpoint(other)
    with pytest.raises(InputError, match="is no safetensors file"):
        load_checkpoint(tmp_path)


def test_other_kinds_and_newer_versions_are_told(tmp_path: Path, trained: Checkpoint) -> None:
    path = tmp_path / "w.safetensors"
    write_tensor_file(path, Kind("the state of a training", 1), trained.weights, {})
    with pytest.raises(InputError, match="holds the state of a training, not weights"):
        load_checkpoint(path)
    write_tensor_file(path, Kind("weights", 99), trained.weights, {})
    with pytest.raises(InputError, match="version 99, this program reads 1 at most; use a newer"):
        load_checkpoint(path)


def test_weights_that_do_not_fit_are_told(trained: Checkpoint, file: Path) -> None:
    def saved(change: Callable[[dict[str, torch.Tensor]], object]) -> Path:
        weights = dict(trained.weights)
        change(weights)
        save_checkpoint(file, replace(trained, weights=weights))
        return file

    with pytest.raises(InputError, match=r"Missing key.*columns\.layers\.8\.bias"):
        load_checkpoint(saved(lambda w: w.pop("columns.layers.8.bias")))
    with pytest.raises(InputError, match=r"size mismatch for columns\.layers\.8\.bias"):
        load_checkpoint(saved(lambda w: w.update({"columns.layers.8.bias": torch.zeros(5)})))
    with pytest.raises(InputError, match=r"columns\.layers\.8\.bias is torch.float32, or not finite"):
        load_checkpoint(saved(lambda w: w.update({"columns.layers.8.bias": torch.full((32,), torch.nan)})))
    with pytest.raises(InputError, match=r"Unexpected key.*surplus"):
        load_checkpoint(saved(lambda w: w.update({"surplus": torch.zeros(1)})))
