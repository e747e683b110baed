"""Weights of a network in a file, with all that is needed to use them: its configuration and that of the images."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError
from torch import Tensor, nn

from lidarslam.core.errors import InputError
from odometry.images.image_config import ImageConfig
from odometry.network.network_config import NetworkConfig
from odometry.network.networks import make_network
from odometry.network.tensor_file import Kind, read_tensor_file, write_tensor_file

WEIGHTS = Kind("weights", version=1)


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A trained network.

    Attributes:
        network: which one.
        images: how scans are shown to it.
        weights: its parameters and buffers by name, finite.
        about: what else is worth knowing, such as what it was trained on; values that JSON can hold.
    """

    network: NetworkConfig
    images: ImageConfig
    weights: dict[str, Tensor]
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
    content = {
        "network": checkpoint.network.model_dump(mode="json"),
        "images": checkpoint.images.model_dump(mode="json"),
        "about": checkpoint.about,
    }
    write_tensor_file(path, WEIGHTS, checkpoint.weights, content)


def load_checkpoint(path: Path) -> Checkpoint:
    """Read weights; that they fit the network they are for is checked here.

    Raises:
        InputError: there is no such file, it is none of ours, or its weights are missing, misshapen or not finite.
    """
    file = read_tensor_file(path, WEIGHTS)
    try:
        network = NetworkConfig.model_validate(file.content.get("network"))
        images = ImageConfig.model_validate(file.content.get("images"))
    except ValidationError as error:
        fault = error.errors()[0]
        key = ".".join(str(part) for part in fault["loc"]) or error.title
        raise InputError(
            f"{path}: its configuration does not fit this program ({key}: {fault['msg'].lower()}); train others"
        ) from error
    about = file.content.get("about")
    _require_fitting(path, network, file.tensors)
    return Checkpoint(network, images, file.tensors, about if isinstance(about, dict) else {})


def network_of(checkpoint: Checkpoint) -> nn.Module:
    """The trained network, a `PairNetwork`, ready for use on the CPU.

    Raises:
        RuntimeError: the weights are not those of this network, which no file that was loaded can have.
    """
    with torch.random.fork_rng(devices=[]):  # the first random weights are thrown away
        network = make_network(checkpoint.network)
    network.load_state_dict(checkpoint.weights)
    return network.eval()


def _require_fitting(path: Path, config: NetworkConfig, weights: Mapping[str, Tensor]) -> None:
    try:
        with torch.device("meta"):  # shapes alone
            expected = make_network(config).state_dict()
    except RuntimeError as error:  # sizes that no memory holds
        raise InputError(f"{path}: its network cannot be made ({error}); the file is damaged, make it again") from error
    for name, value in expected.items():
        if name not in weights:
            raise InputError(f"{path}: {name} of network {config.name} is missing; the file is damaged, make it again")
        if weights[name].shape != value.shape:
            raise InputError(
                f"{path}: {name} is {tuple(weights[name].shape)}, network {config.name} has {tuple(value.shape)};"
                " the file is damaged, make it again"
            )
        if weights[name].is_floating_point() != value.is_floating_point() or weights[name].is_complex():
            raise InputError(
                f"{path}: {name} holds {weights[name].dtype}, network {config.name} has {value.dtype};"
                " the file is damaged, make it again"
            )
        if not bool(weights[name].isfinite().all()):
            raise InputError(f"{path}: {name} holds values that are not finite; its training went wrong, use others")
    surplus = sorted(set(weights) - set(expected))
    if surplus:
        raise InputError(f"{path}: network {config.name} has no {surplus[0]}; the file is of another version")
