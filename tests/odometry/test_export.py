"""Networks as ONNX answer as they do in torch."""

import sys
from pathlib import Path

import pytest
import torch
from torch.nn import functional

from lidarslam.core.errors import ConfigError
from odometry.checkpoint import Checkpoint, checkpoint_of, network_of
from odometry.export import export_onnx
from odometry.image_config import ImageConfig
from odometry.network_config import CorrelationConfig, NetworkConfig
from odometry.networks import make_network

SHAPE = (16, 96)


def untrained(name: str) -> Checkpoint:
    small = CorrelationConfig(rows=16, widths=(8, 16, 16), pair_width=16, reach=2)
    config = NetworkConfig.model_validate({"name": name, "correlation": small})
    torch.manual_seed(5)
    network = make_network(config)
    with torch.no_grad():
        for parameter in network.parameters():  # far from the first weights, with which the answer hardly varies
            parameter.add_(0.02 * torch.randn_like(parameter))
    return checkpoint_of(network, config, ImageConfig(rows=SHAPE[0], columns=SHAPE[1]))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["correlation", "delora"])
def test_onnx_gives_what_torch_gives(name: str, tmp_path: Path) -> None:
    onnxruntime = pytest.importorskip("onnxruntime")
    checkpoint = untrained(name)
    network = network_of(checkpoint)
    encoder, pair = (onnxruntime.InferenceSession(str(path)) for path in export_onnx(checkpoint, tmp_path))
    for scans in (1, 3):  # neither is the number that the graphs were made with
        points = 4.0 * torch.randn(scans, 3, *SHAPE)
        normals = functional.normalize(torch.randn(scans, 3, *SHAPE), dim=1)
        with torch.no_grad():
            features = network.encode(points, normals)
            turned = features.roll(5, dims=3)
            expected = network(features, turned)
        (given,) = encoder.run(None, {"points": points.numpy(), "normals": normals.numpy()})
        torch.testing.assert_close(torch.from_numpy(given), features, rtol=1e-4, atol=1e-4)
        answers = pair.run(None, {"previous": features.numpy(), "current": turned.numpy()})
        for output, answer in zip(pair.get_outputs(), answers, strict=True):
            value = getattr(expected, output.name)
            torch.testing.assert_close(torch.from_numpy(answer), value, rtol=1e-4, atol=1e-4)
        assert len(answers) == (3 if name == "correlation" else 2)


def test_missing_packages_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ConfigError, match=r"pip install 'lidarslam\[export\]'"):
        export_onnx(untrained("correlation"), tmp_path / "out")
    assert not (tmp_path / "out").exists()
