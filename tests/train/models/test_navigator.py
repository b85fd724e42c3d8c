import pytest
import torch

from perilune_train.models.navigator import StackNavigator, WarpNavigator, blurred, local_shift

_SPREAD_M, _ROTATION_RAD = [8.0, 8.0, 4.0], 0.004
_ALTITUDE_M = torch.full((2, 3), 400.0)


@pytest.fixture()
def warp():
    torch.manual_seed(0)
    return WarpNavigator(0.125, "cbam", 16, 1.1, _SPREAD_M, _ROTATION_RAD).eval()


def _pairs(width=64):
    return torch.randn(2, 3, 64, width), torch.randn(2, 3, 64, width)


def test_untrained_networks_give_the_reference_motion(warp):
    stack = StackNavigator(1, 0.125, "cbam", 16).eval()
    assert torch.equal(stack(*_pairs())[0], torch.zeros(2, 3, 9))
    motion, flow, _ = warp(*_pairs(), _ALTITUDE_M)
    assert torch.equal(motion, torch.zeros(2, 3, 9))
    assert flow.shape == (2, 3, 8, 8, 2)


@pytest.mark.parametrize("channels", [1, 3])
def test_pairs_are_stacked_in_height_earlier_above(channels):
    first, second = _pairs(32)
    stacked = StackNavigator(channels, 0.125, "none", 8).stacked(first, second)
    assert stacked.shape == (6, channels, 128, 32)
    torch.testing.assert_close(stacked[4, -1, :64], first[1, 1])
    torch.testing.assert_close(stacked[4, -1, 64:], second[1, 1])


def test_local_shift_of_moved_waves():
    """Waves along x and y, moved by (0.4, -0.3) pixels."""
    u, v = torch.meshgrid(torch.arange(60.0), torch.arange(60.0), indexing="xy")

    def waves(x, y):
        return torch.sin(2 * torch.pi * x / 12) + torch.sin(2 * torch.pi * y / 12)

    pair = torch.stack([waves(u, v), waves(u - 0.4, v + 0.3)])[None]
    found = local_shift(pair)[0, :, 20:40, 20:40]
    torch.testing.assert_close(found, torch.tensor([0.4, -0.3])[:, None, None].expand_as(found), atol=0.04, rtol=0)
    # Seen through a slit, only the shift across it shows; along it nothing is made up.
    slit = torch.stack([torch.sin(u / 2), torch.sin((u - 0.4) / 2)])[None]
    found = local_shift(slit)[0, :, 20:40, 20:40]
    assert (found[0] - 0.4).abs().max() < 0.04 and found[1].abs().max() < 0.01


def test_blurring_is_a_mean_also_at_the_edge():
    image = torch.tensor([[[[0.0, 3, 6], [0, 3, 6], [0, 3, 6]]]])
    assert blurred(image, 3)[0, 0, 1].tolist() == [1.5, 3, 4.5]


def test_warp_sees_both_frames_and_the_shifts(warp):
    first, second = _pairs()
    stacked = warp.stacked(first, second)
    assert stacked.shape == (6, 8, 64, 64)
    torch.testing.assert_close(stacked[4, :2], torch.stack([first[1, 1], second[1, 1]]))
    assert stacked[:, 2:].abs().max() <= 8


def test_plane_flow_agrees_with_the_motion_of_projected_points(warp):
    """The analytic flow beside its numeric twin: points of the plane z = 1, seen before and after a tiny motion."""
    jacobian = warp.plane_flow(8, 8, 64).double()
    focal = 1.1 * 64
    centre = (torch.arange(8) * 8 + 4.0 - 32).double() / focal
    x, y = torch.meshgrid(centre, centre, indexing="xy")
    points = torch.stack([x, y, torch.ones_like(x)], dim=-1)
    tiny = 1e-6
    for k in range(6):
        motion = torch.zeros(6, dtype=torch.float64)
        motion[k] = tiny
        moved = points - motion[:3] + torch.linalg.cross(motion[3:].expand_as(points), points)
        flow = (moved[..., :2] / moved[..., 2:] - points[..., :2]) / tiny
        torch.testing.assert_close(jacobian[..., k], flow, atol=1e-4, rtol=1e-4)


def test_fit_recovers_the_motion_that_made_the_flow_whatever_a_distrusted_place_says(warp):
    with torch.no_grad():
        warp.log_prior.fill_(-16.0)
    expected = torch.tensor([[0.5, -1.0, 0.3, 1.0, -0.5, 2.0]])
    altitude = torch.tensor([250.0])
    motion = expected * warp.unit * torch.tensor([1 / 250] * 3 + [1.0] * 3)
    flow = torch.einsum("hwij,nj->nhwi", warp.plane_flow(8, 8, 64), motion) * 1.1 * 64
    trust = torch.ones(1, 8, 8)
    torch.testing.assert_close(warp.solved(*warp.equations(flow, trust, altitude, 64)), expected, atol=2e-2, rtol=0)
    flow[0, 2, 3] += 5
    assert (warp.solved(*warp.equations(flow, trust, altitude, 64)) - expected).abs().max() > 0.1
    trust[0, 2, 3] = 1e-6
    torch.testing.assert_close(warp.solved(*warp.equations(flow, trust, altitude, 64)), expected, atol=2e-2, rtol=0)


def test_gradients_reach_every_weight(warp):
    motion, flow, _ = warp.train()(*_pairs(), _ALTITUDE_M)
    (motion.sum() + flow.square().sum() + flow.sum()).backward()
    # What starts at zero blocks the gradient of what lies before it for the first step only.
    assert warp.place.weight.grad.abs().max() > 0
    assert warp.recurrent.output.weight.grad.abs().max() > 0


def test_memory_runs_along_the_sequence():
    torch.manual_seed(1)
    network = StackNavigator(1, 0.125, "none", 8).eval()
    torch.nn.init.normal_(network.recurrent.output.weight)
    first, second = _pairs()
    whole, changed = network(first, second)[0], first.clone()
    changed[:, 0] += torch.randn(64, 64)
    late = network(changed, second)[0]
    assert not torch.allclose(whole[:, 2], late[:, 2], atol=1e-7)
    changed = first.clone()
    changed[:, 2] += torch.randn(64, 64)
    torch.testing.assert_close(network(changed, second)[0][:, :2], whole[:, :2])
