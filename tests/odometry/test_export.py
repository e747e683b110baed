"""Networks as ONNX answer as they do in torch."""

import numpy as np
import pytest
import torch
from torch.nn import functional

from lidarslam.core.errors import InputError
from lidarslam.odometry.config import ImageConfig, NetworkConfig
from lidarslam.odometry.network import checkpoint as checkpoints
from lidarslam.odometry.network.candidates import CorrelationSearch
from lidarslam.odometry.network.exported import BIRD, COLUMNS, DESCRIPTION, PEAKS, TURNS, load_exported
from lidarslam.odometry.network.networks import make_network
from lidarslam.odometry.registry import default_weights, shipped_folder

SHAPE = (16, 96)
# Sums in another order differ in the last digits of float32.
TOLERANCE = 1e-4


def untrained(name: str) -> checkpoints.Checkpoint:
    config = NetworkConfig.model_validate({"name": name})
    torch.manual_seed(5)
    network = make_network(config)
    with torch.no_grad():
        for parameter in network.parameters():  # far from the first weights, with which the answer hardly varies
            parameter.add_(0.02 * torch.randn_like(parameter))
    return checkpoints.checkpoint_of(network, config, ImageConfig(rows=SHAPE[0], columns=SHAPE[1]))


def a_scan(seed: int, shape: tuple[int, int] = SHAPE) -> tuple[np.ndarray, np.ndarray]:
    generator = torch.Generator().manual_seed(seed)
    points = 6.0 * torch.randn(3, *shape, generator=generator)
    return points.numpy(), functional.normalize(torch.randn(3, *shape, generator=generator), dim=0).numpy()


def test_the_shipped_graphs_are_the_shipped_weights():
    """Else they were exported from others: `lidarslam export --out odometry/weights/correlation` makes them again."""
    checkpoint, (given, images) = checkpoints.load_checkpoint(default_weights()), load_exported(shipped_folder(), 1)
    assert images == checkpoint.images
    expected = checkpoints.torch_search(checkpoints.network_of(checkpoint))
    assert isinstance(given, CorrelationSearch)
    assert isinstance(expected, CorrelationSearch)
    points, normals = a_scan(0, (checkpoint.images.rows, checkpoint.images.columns))
    rng = np.random.default_rng(0)
    grid = rng.normal(size=(1, 8, 96, 96)).astype(np.float32) * (rng.random((1, 1, 96, 96)) > 0.6)
    shifts = 5.0 * rng.normal(size=(1, 37, 37)).astype(np.float32)
    (features,) = expected.columns(points[None], normals[None])
    other = np.ascontiguousarray(np.roll(features, 7, -1))
    (turns,) = expected.turns(features, other)
    inputs = {"columns": (points[None], normals[None]), "turns": (features, other), "bird": (grid,)}
    for part, values in {**inputs, "peaks": (turns, shifts)}.items():
        for one, same in zip(getattr(given, part)(*values), getattr(expected, part)(*values), strict=True):
            np.testing.assert_allclose(one, same, atol=TOLERANCE * max(1.0, float(np.abs(same).max())))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["correlation", "delora"])
def test_onnx_gives_what_torch_gives(name, tmp_path):
    checkpoint = untrained(name)
    written = checkpoints.export_onnx(checkpoint, tmp_path)
    assert {path.name for path in written} == {path.name for path in tmp_path.iterdir()}
    (given, _), expected = load_exported(tmp_path, 1), checkpoints.torch_search(checkpoints.network_of(checkpoint))
    found, _ = given.compare(given.describe(*a_scan(1)), *a_scan(2))
    wanted, _ = expected.compare(expected.describe(*a_scan(1)), *a_scan(2))
    assert len(found) == len(wanted)
    np.testing.assert_allclose(found[0].T_prev_curr, wanted[0].T_prev_curr, atol=1e-3)
    np.testing.assert_allclose(found[0].covariance, wanted[0].covariance, rtol=1e-2, atol=1e-6)
    assert found[0].log_probability == pytest.approx(wanted[0].log_probability, abs=1e-2)


@pytest.mark.parametrize("content", [None, "{", "[]", '{"kind": "something else"}', "version 1"])
def test_damaged_descriptions_and_graphs_of_another_cell_size_are_refused(tmp_path, content):
    if content == "version 1":
        content = (shipped_folder() / DESCRIPTION).read_text().replace('"version": 2', '"version": 1')
    if content is not None:
        (tmp_path / DESCRIPTION).write_text(content)
    with pytest.raises(InputError, match="lidarslam export"):
        load_exported(tmp_path, 1)


@pytest.mark.parametrize("are_there", [False, True])
def test_damaged_graphs_are_refused(tmp_path, are_there):
    (tmp_path / DESCRIPTION).write_bytes((shipped_folder() / DESCRIPTION).read_bytes())
    for name in (COLUMNS, TURNS, BIRD, PEAKS) if are_there else ():
        (tmp_path / name).write_bytes(b"no graph")
    with pytest.raises(InputError, match=r"columns\.onnx: cannot be used"):
        load_exported(tmp_path, 1)
