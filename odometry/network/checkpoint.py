"""Trained networks: their weights in a file, inference with torch, and export as ONNX.

Files are safetensors, which unlike a pickle run no code of whoever wrote them.
"""

import json
import logging
import tempfile
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from lidarslam.core.errors import InputError
from lidarslam.core.files import cannot_write, replacing
from lidarslam.core.json_text import ANY_OBJECT, parse_json
from lidarslam.odometry.config import ImageConfig, NetworkConfig
from lidarslam.odometry.images import bird_eye
from lidarslam.odometry.images.bird_eye import SHIFTS
from lidarslam.odometry.images.projection import Floats
from lidarslam.odometry.network import exported
from lidarslam.odometry.network.candidates import CorrelationSearch, Graph, Search, WholePairs
from lidarslam.odometry.network.networks import CorrelationNetwork, make_network, of_two_images

_PROGRAM = "lidarslam"


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
        raise cannot_write(path, error) from error


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
        raise InputError(f"{path}: holds no {kind.name} that {_PROGRAM} wrote; name another file")
    try:
        version, content = int(header["version"]), parse_json(header["content"], ANY_OBJECT)
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
    content = exported.describe(checkpoint.network, checkpoint.images) | {"about": checkpoint.about}
    write_tensor_file(path, WEIGHTS, checkpoint.weights, content)


def load_checkpoint(path: Path) -> Checkpoint:
    """Read weights and check that they fit their network.

    InputError where there is no such file, it is no file of weights, or its weights do not fit or are not finite.
    """
    weights, content = read_tensor_file(path, WEIGHTS)
    try:
        checkpoint = Checkpoint(*exported.read_description(content), weights, content.get("about") or {})
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
        return CorrelationSearch(*(graph(part) for part in parts))
    return WholePairs(graph(of_two_images(network)))


# Not a size of anything else, so that no dimension is taken for another.
_EXAMPLE_BATCH = 2


class _Graph(NamedTuple):
    """One file: a function of a network, examples of its inputs, and the names of inputs and outputs."""

    name: str
    function: Callable[..., Any]
    inputs: tuple[Tensor, ...]
    takes: list[str]
    gives: list[str]


class _Function(nn.Module):
    def __init__(self, network: nn.Module, function: Callable[..., Any]) -> None:
        super().__init__()
        self.network, self.function = network, function

    def forward(self, *inputs: Tensor) -> Any:
        return self.function(*inputs)


def export_onnx(checkpoint: Checkpoint, out: Path) -> list[Path]:
    """Write the graphs and a description into a folder, which `--weights` takes.

    The number of scans and pairs stays free, the size of the images does not.

    OutputError where the folder cannot be written.
    """
    network = network_of(checkpoint)
    graphs = _graphs(network, checkpoint.images.rows, checkpoint.images.columns)
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".partial-", dir=out) as workplace:
            folder = Path(workplace)
            for graph in graphs:
                _write(_Function(network, graph.function).eval(), graph, folder / graph.name)
            description = exported.describe(checkpoint.network, checkpoint.images)
            (folder / exported.DESCRIPTION).write_text(json.dumps(description, indent=1) + "\n", encoding="utf-8")
            names = [*(graph.name for graph in graphs), exported.DESCRIPTION]
            for name in names:
                (folder / name).replace(out / name)
    except OSError as error:
        raise cannot_write(out, error) from error
    return [out / name for name in names]


def _graphs(network: nn.Module, rows: int, columns: int) -> list[_Graph]:
    points, normals = torch.rand(2, _EXAMPLE_BATCH, 3, rows, columns)
    if not isinstance(network, CorrelationNetwork):
        images = torch.cat([points, normals], dim=1)
        takes, gives = ["previous", "current"], ["T_prev_curr", "log_sigma"]
        return [_Graph(exported.PAIR, of_two_images(network), (images, images + 1.0), takes, gives)]
    with torch.no_grad():
        features = network.columns(points, normals)
    grids = torch.rand(_EXAMPLE_BATCH, bird_eye.CHANNELS, bird_eye.CELLS, bird_eye.CELLS)
    scores = torch.rand(_EXAMPLE_BATCH, features.shape[-1]), torch.rand(_EXAMPLE_BATCH, SHIFTS, SHIFTS)
    return [
        _Graph(exported.COLUMNS, network.columns, (points, normals), ["points", "normals"], ["features"]),
        _Graph(exported.TURNS, network.turn_scores, (features, features.flip(0)), ["previous", "current"], ["scores"]),
        _Graph(exported.BIRD, network.bird, (grids,), ["grids"], ["features"]),
        _Graph(exported.PEAKS, network.peaks, scores, ["turn_scores", "shift_scores"], ["angle", "shift", "log_sigma"]),
    ]


def _write(module: nn.Module, graph: _Graph, path: Path) -> None:
    batch = torch.export.Dim("batch", min=1)
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it warns about itself
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.export.export(module, graph.inputs, dynamic_shapes=(tuple({0: batch} for _ in graph.inputs),))
        torch.onnx.export(
            program,
            (),
            str(path),
            input_names=graph.takes,
            output_names=graph.gives,
            dynamic_shapes=tuple({0: "batch"} for _ in graph.inputs),
            dynamo=True,
            external_data=False,
            verbose=False,
        )
    _forget_origin(path)


def _forget_origin(path: Path) -> None:
    """Remove which lines of which files the graph came from."""
    import onnx

    model = onnx.load(str(path))
    graphs = [model.graph, *model.functions]
    for part in (model, *graphs, *(node for graph in graphs for node in graph.node)):
        part.ClearField("metadata_props")
        part.ClearField("doc_string")
    for value in (*model.graph.value_info, *model.graph.initializer, *model.graph.input, *model.graph.output):
        value.ClearField("metadata_props")
    onnx.save(model, str(path))
