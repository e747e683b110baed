"""An exported network in ONNX Runtime: inference without torch, which starts at once."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import onnxruntime
from pydantic import ValidationError

from lidarslam.core.errors import InputError
from lidarslam.core.text.json_text import ANY_OBJECT, read_json
from lidarslam.odometry.config import ImageConfig, NetworkConfig
from lidarslam.odometry.network.candidates import CorrelationParts, CorrelationSearch, Graph, Search, WholePairs

DESCRIPTION = "network.json"
COLUMNS, TURNS, BIRD, PEAKS, PAIR = "columns.onnx", "turns.onnx", "bird.onnx", "peaks.onnx", "pair.onnx"

_HEADER = {"kind": "a network exported by lidarslam", "version": 1}
_ERRORS_ONLY = 3


@dataclass(frozen=True)
class Exported:
    """A folder that `lidarslam export` wrote, the network in it, and the size of its images."""

    folder: Path
    network: NetworkConfig
    images: ImageConfig


def describe(network: NetworkConfig, images: ImageConfig) -> dict[str, Any]:
    """The description beside weights or graphs; values that JSON can hold."""
    return _HEADER | {"network": network.model_dump(mode="json"), "images": images.model_dump(mode="json")}


def read_description(content: dict[str, Any]) -> tuple[NetworkConfig, ImageConfig]:
    """The network and the size of its images, as `describe` wrote them.

    Other keys, which were settings once, have had no values but today's constants.

    Raises:
        ValueError: it is no such description.
    """
    try:
        network = NetworkConfig(name=content["network"]["name"])
        return network, ImageConfig(rows=content["images"]["rows"], columns=content["images"]["columns"])
    except (KeyError, TypeError, ValidationError) as error:
        raise ValueError("its description of the network is damaged, or of another version") from error


def read_exported(folder: Path) -> Exported:
    """The network in a folder.

    Raises:
        InputError: it holds no exported network, or one of another version.
    """
    try:
        content = read_json(folder / DESCRIPTION, ANY_OBJECT)
        if {key: content[key] for key in _HEADER} != _HEADER:
            raise ValueError("it is of another version")
        network, images = read_description(content)
    except (OSError, KeyError, ValueError) as error:
        raise InputError(
            f"{folder}: {DESCRIPTION} is missing or damaged ({error}); name a file of weights, or make the folder with"
            " `lidarslam export`"
        ) from error
    return Exported(folder, network, images)


def onnx_search(exported: Exported, threads: int) -> Search:
    """The search for candidates with an exported network, with so many threads for each graph.

    Raises:
        InputError: a graph is missing or cannot be used.
    """
    if exported.network.name != "correlation":
        return WholePairs(_graph(exported.folder / PAIR, threads))
    parts = (_graph(exported.folder / name, threads) for name in (COLUMNS, TURNS, BIRD, PEAKS))
    return CorrelationSearch(CorrelationParts(*parts))


def _graph(path: Path, threads: int) -> Graph:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = _ERRORS_ONLY
    # Threads that wait in a loop for more work would take it from mapping, which works beside.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # of many kinds, all of ONNX Runtime's own
        raise InputError(f"{path}: cannot be used ({error}); make it again with `lidarslam export`") from error
    names = [value.name for value in session.get_inputs()]
    return lambda *inputs: list(session.run(None, dict(zip(names, inputs, strict=True))))
