"""An exported network in ONNX Runtime: inference without torch, which starts at once."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import onnxruntime
from pydantic import ValidationError

from lidarslam.core.errors import InputError
from lidarslam.core.json_text import ANY_OBJECT, read_json
from lidarslam.odometry.config import ImageConfig, NetworkConfig
from lidarslam.odometry.images.projection import Floats
from lidarslam.odometry.network.candidates import CorrelationSearch, Graph, Search, WholePairs

DESCRIPTION = "network.json"
COLUMNS, TURNS, BIRD, PEAKS, PAIR = "columns.onnx", "turns.onnx", "bird.onnx", "peaks.onnx", "pair.onnx"

# To be raised whenever graphs of before mean something else: 2, cells of a metre.
_HEADER = {"kind": "a network exported by lidarslam", "version": 2}
_FATAL_ERRORS_ONLY = 4


def describe(network: NetworkConfig, images: ImageConfig) -> dict[str, Any]:
    """The description stored with weights or graphs; values that JSON can hold."""
    return _HEADER | {"network": network.model_dump(mode="json"), "images": images.model_dump(mode="json")}


def read_description(content: dict[str, Any]) -> tuple[NetworkConfig, ImageConfig]:
    """The network and the size of its images, as `describe` wrote them; ValueError where it is no such description."""
    try:
        network = NetworkConfig(name=content["network"]["name"])
        return network, ImageConfig(rows=content["images"]["rows"], columns=content["images"]["columns"])
    except (KeyError, TypeError, ValidationError) as error:
        raise ValueError("its description of the network is damaged, or of another version") from error


def load_exported(folder: Path, threads: int) -> tuple[Search, ImageConfig]:
    """The search with a network that `lidarslam export` wrote, on `threads` for each graph, and the size of its images.

    InputError where the folder holds no exported network, or one of another version, or a graph cannot be used.
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
    if network.name != "correlation":
        return WholePairs(_graph(folder / PAIR, threads)), images
    return CorrelationSearch(*(_graph(folder / name, threads) for name in (COLUMNS, TURNS, BIRD, PEAKS))), images


def _graph(path: Path, threads: int) -> Graph:
    options, run_options = onnxruntime.SessionOptions(), onnxruntime.RunOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = run_options.log_severity_level = _FATAL_ERRORS_ONLY
    # Threads that wait in a loop for more work would take it from mapping, which runs in parallel.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    with _usable(path):
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    names = [value.name for value in session.get_inputs()]

    def run(*inputs: Floats) -> list[Floats]:
        with _usable(path):
            return list(session.run(None, dict(zip(names, inputs, strict=True)), run_options))

    return run


@contextmanager
def _usable(path: Path) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # of many kinds, all of ONNX Runtime's own
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: cannot be used ({reason}); make it again with `lidarslam export`") from error
