"""Size, names and strides of the backbone."""

import pytest
import torch
from torch import nn

from perilune_train.models.darknet import AttentionDarknet53

NAMES = (
    ["B_11", "B_21", "B_22"]
    + [f"B_3{j}" for j in range(1, 9)]
    + [f"B_4{j}" for j in range(1, 9)]
    + [f"B_5{j}" for j in range(1, 5)]
)


def darknet_floats(network: nn.Module) -> int:
    """Weights, and scale, bias, mean and variance of batch norms: what a Darknet file holds."""
    return sum(value.numel() for key, value in network.state_dict().items() if "num_batches" not in key)


def test_full_size_is_darknet53():
    with torch.device("meta"):
        network = AttentionDarknet53(in_channels=3, width=1.0)
    assert darknet_floats(network) == 40_620_640
    assert sum(isinstance(m, nn.Conv2d) for m in network.modules()) == 52
    assert network.channels == [64, 128, 256, 512, 1024]


def test_strides_and_names():
    network = AttentionDarknet53(1, 0.125, "cbam")
    assert [f.shape for f in network(torch.zeros(2, 1, 64, 96))] == [
        (2, c, 64 // s, 96 // s) for c, s in zip([8, 16, 32, 64, 128], [2, 4, 8, 16, 32], strict=True)
    ]
    assert list(network.attentions) == list(network.units) == NAMES


def test_masks_are_what_forward_multiplies_with():
    torch.manual_seed(0)
    network = AttentionDarknet53(1, 0.125, "cbam", stages=3).eval()
    x = torch.randn(2, 1, 32, 32)
    seen = {}
    for name, cbam in network.attentions.items():
        cbam.register_forward_hook(lambda m, args, out, name=name: seen.update({name: m.gated(args[0])[0]}))
    features = network(x)
    masks = network.attention_masks(x)
    assert list(masks) == NAMES[:11] == list(seen)
    assert masks["B_11"].shape == (2, 1, 16, 16)
    assert masks["B_38"].shape == (2, 1, 4, 4)
    for name, mask in masks.items():
        torch.testing.assert_close(mask, seen[name])
        assert mask.min() > 0 and mask.max() < 1
    assert len(features) == 3


def test_identity_attention_keeps_the_plain_backbones_features():
    torch.manual_seed(0)
    plain = AttentionDarknet53(1, 0.125).eval()
    gated = AttentionDarknet53(1, 0.125, "cbam_identity").eval()
    missing = gated.load_state_dict(plain.state_dict(), strict=False).missing_keys
    assert all(key.startswith("attentions.") for key in missing)
    x = torch.randn(2, 1, 64, 64)
    for a, b in zip(plain(x), gated(x), strict=True):
        assert torch.equal(a, b)


def test_cbam_last_has_one_gate_in_each_stage():
    gated = AttentionDarknet53(1, 0.125, "cbam_last").eval()
    assert list(gated.attention_masks(torch.randn(1, 1, 64, 64))) == ["B_11", "B_22", "B_38", "B_48", "B_54"]
    features, masks = gated.features_and_masks(torch.zeros(1, 1, 64, 64))
    assert len(features) == len(masks) == 5


def test_without_attention_there_are_no_masks():
    assert AttentionDarknet53(1, 0.125).eval().attention_masks(torch.zeros(1, 1, 32, 32)) == {}


def test_number_of_stages_is_checked():
    with pytest.raises(ValueError, match="stages is 6"):
        AttentionDarknet53(stages=6)
