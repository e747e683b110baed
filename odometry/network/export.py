"""A trained network as ONNX: for inference without torch, and for other programs.

The default network becomes one graph for each of its parts; between them only the fast Fourier transform remains,
see `odometry.network.candidates`. Other networks are one graph of pairs.
"""

import json
import logging
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from lidarslam.core.files import cannot_write
from lidarslam.odometry.images import bird_eye
from lidarslam.odometry.images.bird_eye import SHIFTS
from lidarslam.odometry.network.checkpoint import Checkpoint, network_of
from lidarslam.odometry.network.exported import BIRD, COLUMNS, DESCRIPTION, PAIR, PEAKS, TURNS, describe
from lidarslam.odometry.network.networks import CorrelationNetwork, of_two_images

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
    """A function of a network as a module, with the network's weights."""

    def __init__(self, network: nn.Module, function: Callable[..., Any]) -> None:
        super().__init__()
        self.network, self.function = network, function

    def forward(self, *inputs: Tensor) -> Any:
        """Call it."""
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
            description = describe(checkpoint.network, checkpoint.images)
            (folder / DESCRIPTION).write_text(json.dumps(description, indent=1) + "\n", encoding="utf-8")
            names = [*(graph.name for graph in graphs), DESCRIPTION]
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
        return [_Graph(PAIR, of_two_images(network), (images, images + 1.0), takes, gives)]
    with torch.no_grad():
        features = network.columns(points, normals)
    grids = torch.rand(_EXAMPLE_BATCH, bird_eye.CHANNELS, bird_eye.CELLS, bird_eye.CELLS)
    scores = torch.rand(_EXAMPLE_BATCH, features.shape[-1]), torch.rand(_EXAMPLE_BATCH, SHIFTS, SHIFTS)
    return [
        _Graph(COLUMNS, network.columns, (points, normals), ["points", "normals"], ["features"]),
        _Graph(TURNS, network.turn_scores, (features, features.flip(0)), ["previous", "current"], ["scores"]),
        _Graph(BIRD, network.bird, (grids,), ["grids"], ["features"]),
        _Graph(PEAKS, network.peaks, scores, ["turn_scores", "shift_scores"], ["angle", "shift", "log_sigma"]),
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
