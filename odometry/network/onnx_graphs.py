"""Exported networks in ONNX Runtime behind the interfaces of inference: no torch, and a quick start."""

from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from odometry.network.candidates import CorrelationSearch, Search, WholePairs
from odometry.network.exported import BIRD, COLUMNS, PAIR, PEAKS, TURNS, Exported

Floats = NDArray[np.float32]

_ERRORS_ONLY = 3


class OnnxGraphs:
    """The parts of the network `correlation`; implements `odometry.network.candidates.Graphs`.

    Args:
        folder: that the graphs lie in.
        threads: of each graph.

    Raises:
        InputError: a file is no such graph.
    """

    def __init__(self, folder: Path, threads: int) -> None:
        self._columns, self._turns, self._bird, self._peaks = (
            _session(folder / name, threads) for name in (COLUMNS, TURNS, BIRD, PEAKS)
        )

    def columns(self, points: Floats, normals: Floats) -> Floats:
        """See `Graphs`."""
        return _run(self._columns, points=points, normals=normals)[0]

    def turn_scores(self, previous: Floats, current: Floats) -> Floats:
        """See `Graphs`."""
        return _run(self._turns, previous=previous, current=current)[0]

    def bird(self, grid: Floats) -> Floats:
        """See `Graphs`."""
        return _run(self._bird, grids=grid)[0]

    def peaks(self, turn_scores: Floats, shift_scores: Floats) -> tuple[float, Floats, Floats]:
        """See `Graphs`."""
        angle, shift, log_sigma = _run(self._peaks, turn_scores=turn_scores, shift_scores=shift_scores)
        return float(angle[0]), shift[0], log_sigma[0]


def onnx_search(exported: Exported, threads: int) -> Search:
    """The search for candidates that an exported network is made for.

    Raises:
        InputError: its graphs cannot be used.
    """
    if exported.network.name == "correlation":
        return CorrelationSearch(OnnxGraphs(exported.folder, threads))
    pairs = _session(exported.folder / PAIR, threads)

    def network(previous: Floats, current: Floats) -> tuple[Floats, Floats]:
        T_prev_curr, log_sigma = _run(pairs, previous=previous, current=current)
        return T_prev_curr, log_sigma

    return WholePairs(network)


def _session(path: Path, threads: int) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = _ERRORS_ONLY
    # Threads that wait in a loop for more work would take it from mapping, which works beside.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # of many kinds, all of ONNX Runtime's own
        raise InputError(f"{path}: cannot be used ({error}); make it again with `lidarslam export`") from error


def _run(session: onnxruntime.InferenceSession, **inputs: Floats) -> list[Floats]:
    results: list[Floats] = session.run(None, inputs)
    return results
