"""Trained networks: their weights in a file, and inference with torch.

Files are safetensors, which unlike a pickle run no code of whoever wrote them.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field, TypeAdapter, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.files import replacing
from lidarslam.core.json_text import ANY_OBJECT, parse_json
from lidarslam.odometry.config import ImageConfig, NetworkConfig
from lidarslam.odometry.images.projection import Floats
from lidarslam.odometry.network.candidates import CorrelationParts, CorrelationSearch, Graph, Search, WholePairs
from lidarslam.odometry.network.exported import describe, read_description
from lidarslam.odometry.network.networks import CorrelationNetwork, make_network, of_two_images

_PROGRAM = "lidarslam"
_VERSION = TypeAdapter(Annotated[int, Field(ge=0, lt=1 << 31)])


@dataclass(frozen=True)
class Kind:
    """The purpose of a file, in words ("weights"), and the version of its layout; newer ones are refused."""

    name: str
    version: int


def write_tensor_file(path: Path, kind: Kind, tensors: Mapping[str, Tensor], content: Mapping[str, Any]) -> None:
    """Write the file, whole or not at all; OutputError where it cannot be written."""
    header = {"program": _PROGRAM, "kind": kind.name, "version": str(kind.version), "content": json.dumps(content)}
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as partial:
            save_file(plain, partial, metadata=header)
    except (OSError, SafetensorError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise OutputError(f"{path}: cannot be written ({reason})") from error


def read_tensor_file(path: Path, kind: Kind) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The named tensors and the description that `write_tensor_file` wrote.

    InputError where there is no such file, or it is none of this kind, or of a newer version.
    """
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; expected {kind.name} that {_PROGRAM} wrote") from None
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(
            f"{path}: is no safetensors file; expected {kind.name} that {_PROGRAM} wrote, it may be damaged ({error})"
        ) from error
    if header.get("program") != _PROGRAM or header.get("kind") != kind.name:
        found = header.get("kind") if header.get("program") == _PROGRAM else "tensors of another program"
        raise InputError(f"{path}: holds {found}, not {kind.name} that {_PROGRAM} wrote; name another file")
    try:
        content = parse_json(header["content"], ANY_OBJECT)
        version = _VERSION.validate_python(header["version"])
    except ValidationError:
        raise InputError(f"{path}: its version is no number; make it again") from None
    except (KeyError, ValueError) as error:
        raise InputError(f"{path}: its description is damaged ({error}); make it again") from error
    if version > kind.version:
        raise InputError(
            f"{path}: has {kind.name} of version {version}, this program reads {kind.version} at most;"
            f" use a newer {_PROGRAM}"
        )
    return tensors, content


WEIGHTS = Kind("weights", version=1)


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A trained network."""

    network: NetworkConfig  # which one
    images: ImageConfig  # size of its images
    weights: dict[str, Tensor]  # its parameters and buffers by name, finite
    # such as its training data; values that JSON can hold
    about: dict[str, Any] = field(default_factory=dict)


def checkpoint_of(
    network: nn.Module, config: NetworkConfig, images: ImageConfig, about: Mapping[str, Any] | None = None
) -> Checkpoint:
    """A network as it is now; later training does not change the copy."""
    weights = {name: value.detach().cpu().clone() for name, value in network.state_dict().items()}
    return Checkpoint(config, images, weights, dict(about or {}))


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write the file, whole or not at all; OutputError where it cannot be written."""
    content = describe(checkpoint.network, checkpoint.images) | {"about": checkpoint.about}
    write_tensor_file(path, WEIGHTS, checkpoint.weights, content)


def load_checkpoint(path: Path) -> Checkpoint:
    """Read weights and check that they fit their network.

    InputError where there is no such file, it is no file of weights, or its weights do not fit or are not finite.
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

    RuntimeError where the weights are not those of this network, which no file that was loaded can have.
    """
    with torch.device("meta"):  # no random weights, which would be thrown away
        network = make_network(checkpoint.network)
    network.to_empty(device="cpu").load_state_dict(checkpoint.weights)
    return network.eval()


def torch_search(network: nn.Module, device: torch.device | str = "cpu", threads: int = 1) -> Search:
    """The search for candidates with a network in evaluation mode, which is moved to the device.

    torch would use all threads and slow down the mapping that runs in parallel.
    """
    network = network.to(device)

    def graph(part: Callable[..., Any]) -> Graph:
        @torch.inference_mode()
        def run(*inputs: Floats) -> list[Floats]:
            before = torch.get_num_threads()
            torch.set_num_threads(threads)
            try:
                outputs = part(*(torch.from_numpy(values).to(device) for values in inputs))
            finally:
                torch.set_num_threads(before)
            outputs = outputs if isinstance(outputs, tuple) else (outputs,)
            return [np.ascontiguousarray(values.float().numpy(force=True)) for values in outputs]

        return run

    if isinstance(network, CorrelationNetwork):
        parts = (network.columns, network.turn_scores, network.bird, network.peaks)
        return CorrelationSearch(CorrelationParts(*(graph(part) for part in parts)))

    return WholePairs(graph(of_two_images(network)))
