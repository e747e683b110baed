"""An exported network in ONNX Runtime: inference without torch, which starts at once."""

from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from threading import Thread
from time import monotonic, sleep
from typing import Any
from weakref import ref

import onnxruntime
from pydantic import ValidationError

from lidarslam.core.errors import InputError
from lidarslam.core.json_text import ANY_OBJECT, read_json
from lidarslam.odometry.config import ImageConfig, NetworkConfig
from lidarslam.odometry.images.projection import Floats
from lidarslam.odometry.network.candidates import CorrelationParts, CorrelationSearch, Search, WholePairs

DESCRIPTION = "network.json"
COLUMNS, TURNS, BIRD, PEAKS, PAIR = "columns.onnx", "turns.onnx", "bird.onnx", "peaks.onnx", "pair.onnx"

# To be raised whenever graphs of before mean something else: 2, cells of a metre.
_HEADER = {"kind": "a network exported by lidarslam", "version": 2}
_FATAL_ERRORS_ONLY = 4
# Limits of a graph: seconds for one pair of scans, which take milliseconds, and memory for all, which is below 100 MB.
_MOST_S, _MOST_BYTES = 60.0, 1 << 30


@dataclass(frozen=True)
class Exported:
    """A folder that `lidarslam export` wrote, the network in it, and the size of its images."""

    folder: Path
    network: NetworkConfig
    images: ImageConfig


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


def read_exported(folder: Path) -> Exported:
    """The network in a folder; InputError where it holds no exported network, or one of another version."""
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
    """The search for candidates with an exported network, with `threads` threads for each graph.

    InputError where a graph is missing or cannot be used.
    """
    if exported.network.name != "correlation":
        return WholePairs(_Graph(exported.folder / PAIR, threads))
    parts = (_Graph(exported.folder / name, threads) for name in (COLUMNS, TURNS, BIRD, PEAKS))
    return CorrelationSearch(CorrelationParts(*parts))


class _Graph:
    """A graph of bounded time and memory: it is part of a file from elsewhere, and may loop without end."""

    def __init__(self, path: Path, threads: int) -> None:
        _bound_memory()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.log_severity_level = _FATAL_ERRORS_ONLY
        # Threads that wait in a loop for more work would take it from mapping, which runs in parallel.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.add_session_config_entry("session.use_env_allocators", "1")
        self._path, self._run, self.deadline_s = path, onnxruntime.RunOptions(), float("inf")
        self._run.log_severity_level = _FATAL_ERRORS_ONLY
        try:
            self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # of many kinds, all of ONNX Runtime's own
            raise self._unusable(error) from error
        self._inputs = [value.name for value in self._session.get_inputs()]
        _watched().append(ref(self))

    def __call__(self, *inputs: Floats) -> list[Floats]:
        self.deadline_s = monotonic() + _MOST_S
        try:
            return list(self._session.run(None, dict(zip(self._inputs, inputs, strict=True)), self._run))
        except Exception as error:
            raise self._unusable(error) from error
        finally:
            self.deadline_s = float("inf")

    def end(self) -> None:
        """End the computation in progress."""
        self._run.terminate = True

    def _unusable(self, error: Exception) -> InputError:
        reason = " ".join(str(error).split())
        return InputError(f"{self._path}: cannot be used ({reason}); make it again with `lidarslam export`")


@cache
def _bound_memory() -> None:
    memory = onnxruntime.OrtMemoryInfo(
        "Cpu", onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, onnxruntime.OrtMemType.DEFAULT
    )
    limits = dict.fromkeys(("arena_extend_strategy", "initial_chunk_size_bytes", "max_dead_bytes_per_chunk"), -1)
    with suppress(Exception):  # the process has one of its own already
        onnxruntime.create_and_register_allocator(memory, onnxruntime.OrtArenaCfg({"max_mem": _MOST_BYTES, **limits}))


@cache
def _watched() -> "list[ref[_Graph]]":
    """All graphs, which a thread of its own ends at their deadlines."""
    graphs: list[ref[_Graph]] = []

    def watch() -> None:
        while True:
            sleep(1.0)
            for graph in (reference() for reference in tuple(graphs)):
                if graph is not None and monotonic() > graph.deadline_s:
                    graph.end()

    Thread(target=watch, daemon=True, name="deadlines of graphs").start()
    return graphs
