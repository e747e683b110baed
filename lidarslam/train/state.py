"""All that a training needs to go on exactly as if it had never stopped, in a file; no pickle."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from lidarslam.core.errors import InputError
from odometry.network.tensor_file import Kind, read_tensor_file, write_tensor_file

_KIND = Kind("the state of a training", version=1)
_NETWORK, _OPTIMIZER = "network/", "optimizer/"


@dataclass
class Standing:
    """How far a training has come, next to weights and moments.

    Attributes:
        step: how many steps are done.
        best: the lowest score of a validation so far, None before the first.
        sums: of each part of the loss since the last line of the log.
        counted: over how many steps.
        loss_scale: see `Devices.loss_scale`.
        data: names what is trained on.
    """

    step: int = 0
    best: float | None = None
    sums: dict[str, float] = field(default_factory=dict)
    counted: int = 0
    loss_scale: dict[str, float] = field(default_factory=dict)
    data: str = ""


def save_state(path: Path, network: nn.Module, optimizer: torch.optim.Optimizer, standing: Standing) -> None:
    """Write the file, whole or not at all.

    Raises:
        OutputError: it cannot be written.
    """
    tensors: dict[str, Tensor] = {_NETWORK + name: value for name, value in network.state_dict().items()}
    for number, moments in optimizer.state_dict()["state"].items():
        tensors |= {f"{_OPTIMIZER}{number}/{name}": torch.as_tensor(value) for name, value in moments.items()}
    write_tensor_file(path, _KIND, tensors, vars(standing))


def load_state(path: Path, network: nn.Module, optimizer: torch.optim.Optimizer) -> Standing:
    """Put weights and moments back; the network and the optimizer must be as they were made.

    Raises:
        InputError: the file is not usable, or belongs to another network.
    """
    file = read_tensor_file(path, _KIND)
    weights, moments = {}, dict[int, dict[str, Tensor]]()
    for name, tensor in file.tensors.items():
        if name.startswith(_NETWORK):
            weights[name.removeprefix(_NETWORK)] = tensor
        else:
            number, key = name.removeprefix(_OPTIMIZER).split("/")
            moments.setdefault(int(number), {})[key] = tensor
    try:
        network.load_state_dict(weights)
        standing = Standing(**_known(file.content))
    except (RuntimeError, TypeError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"{path}: does not belong to this network; go on with the configuration it was begun with ({reason[:200]})"
        ) from error
    optimizer.load_state_dict({"state": moments, "param_groups": optimizer.state_dict()["param_groups"]})
    return standing


def _known(content: dict[str, Any]) -> dict[str, Any]:
    return {name: content[name] for name in vars(Standing()) if name in content}
