"""The directory of a training: its files, and the state from which it resumes without a difference."""

import shutil
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import torch
from pydantic import TypeAdapter
from torch import Tensor, nn

from lidarslam.config.settings import SOURCES_SECTION
from lidarslam.core.errors import InputError, OutputError
from lidarslam.odometry.network.checkpoint import Kind, read_tensor_file, write_tensor_file

CONFIG = "config.yaml"
WEIGHTS = "weights.safetensors"
LAST_WEIGHTS = "weights_last.safetensors"
STATE = "state.safetensors"
LOSSES = "train.csv"
VALIDATION = "validation.csv"
CURVES = "tensorboard"
PREPARED = "prepared"

# Prepared recordings are no results: another training in the directory uses them again.
RESULTS = (CONFIG, WEIGHTS, LAST_WEIGHTS, STATE, LOSSES, VALIDATION, CURVES)


def earlier_training(path: Path, resume: bool, overwrite: bool) -> list[str]:
    """The files of a training in the directory, if it may be resumed or replaced.

    Raises:
        OutputError: it holds a training and neither is asked for, holds other files of these names, or there is none
            to resume.
    """
    present = [name for name in RESULTS if (path / name).exists()]
    listed = f"{', '.join(present[:3])}{', ...' if len(present) > 3 else ''}"
    if present and not is_training(path):
        raise OutputError(f"{path}: holds files that are not those of a training ({listed}); name another directory")
    if resume and not present:
        raise OutputError(f"{path}: holds no training to go on with; leave --resume out to begin one")
    if present and not resume and not overwrite:
        raise OutputError(
            f"{path}: holds a training already ({listed}); name another directory, go on with it by --resume,"
            " or replace it with --overwrite"
        )
    return present


def remove_results(path: Path, names: Iterable[str]) -> None:
    """Make room for another training; the remains of a killed one can neither be resumed nor are they foreign."""
    for name in sorted(names, key=lambda name: (name == CONFIG, name != STATE)):
        if (path / name).is_dir() and not (path / name).is_symlink():
            shutil.rmtree(path / name)
        else:
            (path / name).unlink()


def is_training(path: Path) -> bool:
    """Whether the directory is of a training: the first section of its configuration names the recordings."""
    try:
        return (path / CONFIG).read_text(encoding="utf-8").startswith(f"{SOURCES_SECTION}:")
    except (OSError, UnicodeDecodeError):
        return False


_KIND = Kind("the state of a training", version=1)
_NETWORK, _OPTIMIZER = "network/", "optimizer/"


@dataclass
class Progress:
    """The state other than weights and moments."""

    step: int = 0  # number of steps done
    best: float | None = None  # the lowest score of a validation so far, None before the first
    sums: dict[str, float] = field(default_factory=dict)  # of each part of the loss since the last line of the log
    counted: int = 0  # number of these steps
    data: str = ""  # digest of the recordings


_SHAPE = TypeAdapter(Progress)


def save_state(path: Path, network: nn.Module, optimizer: torch.optim.Optimizer, progress: Progress) -> None:
    """Write the file, whole or not at all; OutputError where it cannot be written."""
    tensors: dict[str, Tensor] = {_NETWORK + name: value for name, value in network.state_dict().items()}
    for number, moments in optimizer.state_dict()["state"].items():
        tensors |= {f"{_OPTIMIZER}{number}/{name}": torch.as_tensor(value) for name, value in moments.items()}
    write_tensor_file(path, _KIND, tensors, vars(progress))


def load_state(path: Path, network: nn.Module, optimizer: torch.optim.Optimizer) -> Progress:
    """Restore weights and moments; the network and the optimizer must be as they were made.

    InputError where the file is not usable, or belongs to another network.
    """
    tensors, content = read_tensor_file(path, _KIND)
    try:
        weights = _below(tensors, _NETWORK)
        moments = _moments(
            _below(tensors, _OPTIMIZER), [p for group in optimizer.param_groups for p in group["params"]]
        )
        if damaged := next((name for name, tensor in tensors.items() if not bool(tensor.isfinite().all())), None):
            raise ValueError(f"{damaged} is not finite")
        network.load_state_dict(weights)
        optimizer.load_state_dict({"state": moments, "param_groups": optimizer.state_dict()["param_groups"]})
        return _SHAPE.validate_python(content)
    except (RuntimeError, ValueError, KeyError, IndexError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"{path}: does not belong to this network; go on with the configuration it was begun with ({reason[:200]})"
        ) from error


def _below(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}


def _moments(tensors: dict[str, Tensor], parameters: list[nn.Parameter]) -> dict[int, dict[str, Tensor]]:
    """The moments of each parameter by its number: of its shape, or a number of steps."""
    moments = dict[int, dict[str, Tensor]]()
    for name, tensor in tensors.items():
        number, _, key = name.partition("/")
        if not number.isdecimal() or tensor.shape not in (torch.Size(), parameters[int(number)].shape):
            raise ValueError(f"{name} has the shape {tuple(tensor.shape)}")
        moments.setdefault(int(number), {})[key] = tensor
    return moments
