"""Weights of a network in a file, with its name and the size of its images."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from lidarslam.core.errors import InputError
from lidarslam.odometry.config import ImageConfig, NetworkConfig
from lidarslam.odometry.network.exported import describe, read_description
from lidarslam.odometry.network.networks import make_network
from lidarslam.odometry.network.tensor_file import Kind, read_tensor_file, write_tensor_file

WEIGHTS = Kind("weights", version=1)


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A trained network."""

    network: NetworkConfig  # which one
    images: ImageConfig  # size of its images
    weights: dict[str, Tensor]  # its parameters and buffers by name, finite
    # what it was trained on and the like; values that JSON can hold
    about: dict[str, Any] = field(default_factory=dict)


def checkpoint_of(
    network: nn.Module, config: NetworkConfig, images: ImageConfig, about: Mapping[str, Any] | None = None
) -> Checkpoint:
    """A network as it is now; later training does not change the copy."""
    weights = {name: value.detach().cpu().clone() for name, value in network.state_dict().items()}
    return Checkpoint(config, images, weights, dict(about or {}))


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write the file, whole or not at all.

    Raises:
        OutputError: it cannot be written.
    """
    content = describe(checkpoint.network, checkpoint.images) | {"about": checkpoint.about}
    write_tensor_file(path, WEIGHTS, checkpoint.weights, content)


def load_checkpoint(path: Path) -> Checkpoint:
    """Read weights and check that they fit their network.

    Raises:
        InputError: there is no such file, it is none of ours, or its weights do not fit or are not finite.
    """
    weights, content = read_tensor_file(path, WEIGHTS)
    try:
        checkpoint = Checkpoint(*read_description(content), weights, content.get("about") or {})
        expected = network_of(checkpoint).state_dict()
        for name, value in weights.items():
            if value.dtype != expected[name].dtype or not bool(value.isfinite().all()):
                raise ValueError(f"{name} is {value.dtype}, or not finite")
    except (ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: does not fit this program ({reason}); use other weights") from error
    return checkpoint


def network_of(checkpoint: Checkpoint) -> nn.Module:
    """The trained network, a `PairNetwork`, ready for use on the CPU.

    Raises:
        RuntimeError: the weights are not those of this network, which no file that was loaded can have.
    """
    with torch.device("meta"):  # no random weights, which would be thrown away
        network = make_network(checkpoint.network)
    network.to_empty(device="cpu").load_state_dict(checkpoint.weights)
    return network.eval()
