import pytest
import torch
from torch import Tensor

from lidarslam.odometry.network.networks import DeloraNetwork, PairImages


@pytest.fixture(scope="module")
def network() -> DeloraNetwork:
    torch.manual_seed(0)
    return DeloraNetwork().eval()


def _images(batch: int = 2, height: int = 16, width: int = 128) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(4)
    prev, curr = 0.2 * torch.randn(2, batch, 6, height, width, generator=g)
    return prev, curr


def motion(network: DeloraNetwork, prev: Tensor, curr: Tensor) -> Tensor:
    """(B, 4, 4) by points and normals (B, 6, H, W)."""
    return network(PairImages(prev, curr)).T_prev_curr


def features(network: DeloraNetwork, prev: Tensor, curr: Tensor) -> Tensor:
    """(B, 512, ceil(H/2), ceil(W/32)) before pooling."""
    images = [torch.cat([x[:, :3], x[:, :3].norm(dim=1, keepdim=True)], dim=1) for x in (prev, curr)]
    return network.stages(network.stem(torch.cat(images, dim=1)))


def test_has_the_parameters_of_the_published_weights(network: DeloraNetwork) -> None:
    assert sum(p.numel() for p in network.parameters()) == 11_876_019
    heads = sum(p.numel() for head in (network.rotation, network.translation) for p in head.parameters())
    assert heads == 200_907


@pytest.mark.parametrize("scale", [0.1, 30.0])
@torch.no_grad()
def test_outputs_are_rigid(network: DeloraNetwork, scale: float) -> None:
    prev, curr = _images(3)
    T = motion(network, scale * prev, scale * curr)
    R = T[:, :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3).expand(3, 3, 3), rtol=0, atol=1e-6)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(3))
    assert torch.equal(T[:, 3], torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(3, 4))


@torch.no_grad()
def test_items_of_a_batch_do_not_see_each_other(network: DeloraNetwork) -> None:
    prev, curr = _images()
    curr[1] *= 100.0
    together = motion(network, prev, curr)
    for item in range(2):
        alone = motion(network, prev[item, None], curr[item, None])[0]
        torch.testing.assert_close(together[item], alone, rtol=0, atol=1e-6)
    assert (together[0] - together[1]).abs().max() > 1e-4


@torch.no_grad()
def test_azimuth_has_no_seam(network: DeloraNetwork) -> None:
    images = _images()
    rolled = [x.roll(64, dims=3) for x in images]
    found = features(network, *images)
    torch.testing.assert_close(features(network, *rolled), found.roll(2, dims=3), rtol=0, atol=1e-5)
    torch.testing.assert_close(motion(network, *rolled), motion(network, *images), rtol=0, atol=1e-5)
    assert (found.roll(1, dims=3) - found).abs().max() > 1e-2  # or the comparison would say nothing
    upside = features(network, *(x.roll(8, dims=2) for x in images))
    assert (upside - found.roll(4, dims=2)).abs().max() > 1e-2  # elevation is not a circle


def test_gradients_reach_every_parameter() -> None:
    torch.manual_seed(0)
    network = DeloraNetwork()
    T = motion(network, *_images(2, 16, 64))
    T[:, :3].square().mul(torch.arange(12.0).reshape(3, 4)).sum().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().max() > 0, name
