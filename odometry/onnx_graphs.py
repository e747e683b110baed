"""Exported networks in ONNX Runtime behind the interfaces of inference: no torch, and a quick start."""

from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from odometry.candidates import Candidate, CorrelationSearch, Described, Search
from odometry.exported import BIRD, COLUMNS, PAIR, PEAKS, TURNS, Exported

Floats = NDArray[np.float32]

_ERRORS_ONLY = 3


class OnnxGraphs:
    """The parts of the network `correlation`; implements `odometry.candidates.Graphs`.

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


class OnnxPairs:
    """A network of pairs, with its one motion as the only candidate; implements `Search`."""

    def __init__(self, folder: Path, threads: int) -> None:
        self._pairs = _session(folder / PAIR, threads)

    def describe(self, points: Floats, normals: Floats, heading: float = 0.0) -> Described:
        """The image itself."""
        return Described(np.concatenate([points, normals])[None], np.zeros((0, 0, 0), dtype=np.complex64), heading)

    def compare(self, previous: Described, points: Floats, normals: Floats) -> tuple[tuple[Candidate, ...], Described]:
        """See `Search`."""
        current = self.describe(points, normals)
        T_prev_curr, log_sigma = _run(self._pairs, previous=previous.columns, current=current.columns)
        variances = np.exp(2.0 * log_sigma[0].astype(np.float64))
        return (Candidate(T_prev_curr[0].astype(np.float64), np.diag(variances), 0.0),), current


def onnx_search(exported: Exported, threads: int) -> Search:
    """The search for candidates that an exported network is made for.

    Raises:
        InputError: its graphs cannot be used.
    """
    if exported.network.name == "correlation":
        return CorrelationSearch(OnnxGraphs(exported.folder, threads))
    return OnnxPairs(exported.folder, threads)


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
