"""A trained network for other programs: ONNX, in two graphs, because what is kept of a scan serves several pairs."""

import logging
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import torch
from torch import Tensor, nn

from lidarslam.core.errors import ConfigError, OutputError
from odometry.checkpoint import Checkpoint, network_of
from odometry.networks import PairNetwork

ENCODER, PAIR = "encoder.onnx", "pair.onnx"
# Not a size of anything else, so that no dimension is taken for another.
_EXAMPLE_BATCH = 2


class EncoderGraph(nn.Module):
    """(B, 3, H, W) points and normals -> what is kept of each scan."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, points: Tensor, normals: Tensor) -> Tensor:
        """Encode."""
        return cast(PairNetwork, self.network).encode(points, normals)


class PairGraph(nn.Module):
    """What is kept of two scans -> motion (B, 4, 4), log sigma (B, 6), turn scores (B, S; none with DeLORA)."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, previous: Tensor, current: Tensor) -> tuple[Tensor, ...]:
        """Compare."""
        estimate = self.network(previous, current)
        outputs = (estimate.T_prev_curr, estimate.log_sigma, estimate.turn_scores)
        return outputs if estimate.turn_scores.shape[1] else outputs[:2]


def export_onnx(checkpoint: Checkpoint, out: Path) -> tuple[Path, Path]:
    """Write both graphs into a folder; the number of scans and pairs stays free, the size of the images does not.

    Raises:
        ConfigError: the packages for it are not installed.
        OutputError: the folder cannot be written.
    """
    _require_packages()
    network = network_of(checkpoint)
    shape = (_EXAMPLE_BATCH, 3, checkpoint.images.rows, checkpoint.images.columns)
    points, normals = torch.rand(shape), torch.rand(shape)
    encoder, pair = EncoderGraph(network).eval(), PairGraph(network).eval()
    with torch.no_grad():
        features = encoder(points, normals)
        results = len(pair(features, features))
    names = ["T_prev_curr", "log_sigma", "turn_scores"][:results]
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".partial-", dir=out) as workplace:
            folder = Path(workplace)
            _write(encoder, (points, normals), ["points", "normals"], ["features"], folder / ENCODER)
            _write(pair, (features, features.flip(0)), ["previous", "current"], names, folder / PAIR)
            for name in (ENCODER, PAIR):
                (folder / name).replace(out / name)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror or error})") from error
    return out / ENCODER, out / PAIR


def _write(
    graph: nn.Module, inputs: tuple[Tensor, ...], takes: Sequence[str], gives: Sequence[str], path: Path
) -> None:
    batch = torch.export.Dim("batch", min=1)
    operators = torch.export.default_decompositions()
    operators[torch.ops.aten.hypot.default] = _hypot
    with _quiet_exporter():
        program = torch.export.export(graph, inputs, dynamic_shapes=tuple({0: batch} for _ in inputs))
        torch.onnx.export(
            program.run_decompositions(operators),
            (),
            str(path),
            input_names=list(takes),
            output_names=list(gives),
            dynamic_shapes=tuple({0: "batch"} for _ in inputs),
            dynamo=True,
            external_data=False,
            verbose=False,
        )


@contextmanager
def _quiet_exporter() -> Iterator[None]:
    """Without the exporter's warnings about itself and what else could be installed."""
    exporter = logging.getLogger("torch.onnx")
    level = exporter.level
    exporter.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        exporter.setLevel(level)


def _hypot(x: Tensor, y: Tensor) -> Tensor:
    """The one operator that ONNX lacks; lengths of points are far from where squares overflow."""
    return (x * x + y * y).sqrt()


def _require_packages() -> None:
    try:
        import onnx  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise ConfigError(
            f"{error.name} is not installed, which writing ONNX needs; pip install 'lidarslam[export]'"
        ) from error
