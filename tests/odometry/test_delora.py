import pytest
import torch
from torch import Tensor

from odometry.network.correlation import PairImages
from odometry.network.delora import DeloraNetwork
from odometry.network.networks import DeloraPairs


@pytest.fixture(scope="module")
def network() -> DeloraNetwork:
    torch.manual_seed(0)
    return DeloraNetwork().eval()


def _images(batch: int = 2, height: int = 16, width: int = 128) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(4)
    prev, curr = 0.2 * torch.randn(2, batch, 4, height, width, generator=g)
    return prev, curr


def test_has_the_parameters_of_the_published_weights(network: DeloraNetwork) -> None:
    assert sum(p.numel() for p in network.parameters()) == 11_876_019
    heads = sum(p.numel() for head in (network.rotation, network.translation) for p in head.parameters())
    assert heads == 200_907


@pytest.mark.parametrize(("height", "width", "columns"), [(16, 16, 1), (17, 45, 2), (64, 720, 23)])
@torch.no_grad()
def test_any_image_size(network: DeloraNetwork, height: int, width: int, columns: int) -> None:
    images = _images(1, height, width)
    assert network.features(*images).shape == (1, 512, (height + 1) // 2, columns)
    T = network(*images)
    assert T.shape == (1, 4, 4)
    assert T.isfinite().all()


@pytest.mark.parametrize("scale", [0.1, 30.0])
@torch.no_grad()
def test_outputs_are_rigid(network: DeloraNetwork, scale: float) -> None:
    prev, curr = _images(3)
    T = network(scale * prev, scale * curr)
    R = T[:, :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3).expand(3, 3, 3), rtol=0, atol=1e-6)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(3))
    assert torch.equal(T[:, 3], torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(3, 4))


@torch.no_grad()
def test_begins_near_the_identity(network: DeloraNetwork) -> None:
    prev, curr = _images()
    T = network(50.0 * prev, 50.0 * curr)
    assert (T - torch.eye(4)).abs().max() < 0.2
    assert (T - torch.eye(4)).abs().max() > 0.0


@torch.no_grad()
def test_items_of_a_batch_do_not_see_each_other(network: DeloraNetwork) -> None:
    prev, curr = _images()
    curr[1] *= 100.0
    together = network(prev, curr)
    for item in range(2):
        alone = network(prev[item, None], curr[item, None])[0]
        torch.testing.assert_close(together[item], alone, rtol=0, atol=1e-6)
    assert (together[0] - together[1]).abs().max() > 1e-4


@torch.no_grad()
def test_azimuth_has_no_seam(network: DeloraNetwork) -> None:
    images = _images()
    rolled = [x.roll(64, dims=3) for x in images]
    features = network.features(*images)
    torch.testing.assert_close(network.features(*rolled), features.roll(2, dims=3), rtol=0, atol=1e-5)
    torch.testing.assert_close(network(*rolled), network(*images), rtol=0, atol=1e-5)
    assert (features.roll(1, dims=3) - features).abs().max() > 1e-2  # or the comparison would say nothing
    upside = network.features(*(x.roll(8, dims=2) for x in images))
    assert (upside - features.roll(4, dims=2)).abs().max() > 1e-2  # elevation is not a circle


@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_gradients_reach_every_parameter(activation) -> None:
    torch.manual_seed(0)
    network = DeloraNetwork(activation, range_scale_m=2.0)
    T = network(*_images(2, 16, 64))
    T[:, :3].square().mul(torch.arange(12.0).reshape(3, 4)).sum().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().max() > 0, name


@torch.no_grad()
def test_range_scale_divides_the_images() -> None:
    torch.manual_seed(0)
    plain, scaled = DeloraNetwork(), DeloraNetwork(range_scale_m=8.0)
    scaled.load_state_dict(plain.state_dict())
    prev, curr = _images(1)
    torch.testing.assert_close(scaled(8.0 * prev, 8.0 * curr), plain(prev, curr))
    assert (scaled(prev, curr) - plain(prev, curr)).abs().max() > 1e-5


def test_order_of_the_images_matters(network: DeloraNetwork) -> None:
    prev, curr = _images(1)
    assert (network(prev, curr) - network(curr, prev)).abs().max() > 1e-5


@pytest.mark.parametrize("shapes", [((1, 4, 16, 16), (2, 4, 16, 16)), ((1, 3, 16, 16),) * 2, ((1, 4, 16, 15),) * 2])
def test_refuses_other_images(network: DeloraNetwork, shapes) -> None:
    with pytest.raises(ValueError, match="are needed, got"):
        network(*(torch.zeros(shape) for shape in shapes))


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan")])
def test_refuses_a_scale_that_is_not_positive(scale: float) -> None:
    with pytest.raises(ValueError, match="range_scale_m"):
        DeloraNetwork(range_scale_m=scale)


@torch.no_grad()
def test_half_precision_does_not_reach_the_motion(network: DeloraNetwork) -> None:
    """Three digits are enough for features, not for a rotation."""
    images = _images()
    exact = network(*images)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        T = network(*images)
    assert T.dtype == torch.float32
    R = T[:, :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3).expand(2, 3, 3), rtol=0, atol=1e-6)
    torch.testing.assert_close(T, exact, rtol=0, atol=5e-3)


@torch.no_grad()
def test_half_precision_leaves_whole_estimates() -> None:
    prev, curr = _images()
    pairs = DeloraPairs()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        estimate = pairs(PairImages(*(torch.cat([images[:, :3]] * 2, dim=1) for images in (prev, curr))))
    assert {value.dtype for value in vars(estimate).values()} == {torch.float32}
