"""The state of a training in a file, from which it goes on exactly as if it had never stopped; no pickle."""

from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor, nn

from lidarslam.core.errors import InputError
from lidarslam.odometry.network.tensor_file import Kind, read_tensor_file, write_tensor_file

_KIND = Kind("the state of a training", version=1)
_NETWORK, _OPTIMIZER = "network/", "optimizer/"


@dataclass
class Progress:
    """The state beside weights and moments."""

    step: int = 0  # how many steps are done
    best: float | None = None  # the lowest score of a validation so far, None before the first
    sums: dict[str, float] = field(default_factory=dict)  # of each part of the loss since the last line of the log
    counted: int = 0  # over how many steps
    data: str = ""  # digest of the recordings


def save_state(path: Path, network: nn.Module, optimizer: torch.optim.Optimizer, progress: Progress) -> None:
    """Write the file, whole or not at all.

    Raises:
        OutputError: it cannot be written.
    """
    tensors: dict[str, Tensor] = {_NETWORK + name: value for name, value in network.state_dict().items()}
    for number, moments in optimizer.state_dict()["state"].items():
        tensors |= {f"{_OPTIMIZER}{number}/{name}": torch.as_tensor(value) for name, value in moments.items()}
    write_tensor_file(path, _KIND, tensors, vars(progress))


def load_state(path: Path, network: nn.Module, optimizer: torch.optim.Optimizer) -> Progress:
    """Restore weights and moments; the network and the optimizer must be as they were made.

    Raises:
        InputError: the file is not usable, or belongs to another network.
    """
    tensors, content = read_tensor_file(path, _KIND)
    weights, moments = {}, dict[int, dict[str, Tensor]]()
    for name, tensor in tensors.items():
        if name.startswith(_NETWORK):
            weights[name.removeprefix(_NETWORK)] = tensor
        else:
            number, key = name.removeprefix(_OPTIMIZER).split("/")
            moments.setdefault(int(number), {})[key] = tensor
    try:
        network.load_state_dict(weights)
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"{path}: does not belong to this network; go on with the configuration it was begun with ({reason[:200]})"
        ) from error
    optimizer.load_state_dict({"state": moments, "param_groups": optimizer.state_dict()["param_groups"]})
    return Progress(**{name: content[name] for name in vars(Progress()) if name in content})
