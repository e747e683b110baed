"""Running the network: in torch with its settings, and an odometry that needs no torch for all the rest."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from lidarslam.core.geometry import exp
from odometry.correlation import Estimate
from odometry.runner import Guess
from odometry.torch_runner import TorchRunner

POINTS = np.ones((1, 3, 16, 90), dtype=np.float32)


class Watching:
    """A network that answers with what it is built with, and sees under which settings it is called."""

    def __init__(self) -> None:
        self.threads, self.autocast, self.gradients = 0, False, True

    def encode(self, points: Tensor, normals: Tensor) -> Tensor:  # noqa: ARG002
        self.threads, self.gradients = torch.get_num_threads(), torch.is_grad_enabled()
        self.autocast = torch.is_autocast_enabled("cpu")
        return points.bfloat16()

    def __call__(self, previous: Tensor, current: Tensor) -> Estimate:
        T = torch.from_numpy(exp([0.0, 0.0, 0.1, float(previous.sum() > current.sum()), 0.0, 0.0])).float()
        return Estimate(T[None], torch.arange(6.0)[None], torch.zeros(1, 0))


def test_arrays_go_in_and_come_out():
    runner = TorchRunner(Watching())
    features = runner.encode(POINTS, POINTS)
    assert isinstance(features, np.ndarray)
    assert features.dtype == np.float32
    guess = runner.compare(features, 0.5 * features)
    np.testing.assert_allclose(guess.T_prev_curr, exp([0.0, 0.0, 0.1, 1.0, 0.0, 0.0]), atol=1e-6)
    np.testing.assert_allclose(guess.sigma, np.exp(np.arange(6.0)))
    assert guess.T_prev_curr.dtype == guess.sigma.dtype == np.float64


def test_the_number_of_threads_is_as_it_was_before():
    network, before = Watching(), torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        TorchRunner(network, threads=1).encode(POINTS, POINTS)
        assert network.threads == 1
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_nothing_is_kept_for_gradients():
    network = Watching()
    TorchRunner(network).encode(POINTS, POINTS)
    assert not network.gradients


@pytest.mark.parametrize("half", [True, False])
def test_half_precision_is_for_encoding(half):
    network = Watching()
    TorchRunner(network, bfloat16=half).encode(POINTS, POINTS)
    assert network.autocast == half


@pytest.mark.parametrize(
    ("motion", "sigma", "is_motion"),
    [(1.0, 0.1, True), (np.nan, 0.1, False), (1.0, np.nan, False), (1.0, np.inf, False), (1.0, 0.0, False)],
)
def test_a_guess_is_a_motion_if_all_of_it_is_finite(motion, sigma, is_motion):
    assert Guess(motion * np.eye(4), np.full(6, sigma)).is_motion() == is_motion


def test_the_odometry_loads_no_torch():
    """Only what runs the network may; a program that runs it otherwise starts in a fraction of the time."""
    code = (
        "import sys, odometry.learned, odometry.alignment_search, odometry.sweep_images, odometry.runner;"
        "print('torch' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False
    )
    assert done.stdout.strip() == "False", done.stderr
