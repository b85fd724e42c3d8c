from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch
from scipy.stats import spearmanr
from torchmetrics.functional.image import structural_similarity_index_measure

from perilune_train.explain.evidence.randomisation import cascade, randomised, similarity
from perilune_train.models.darknet import AttentionDarknet53


@pytest.fixture(scope="module")
def backbone():
    torch.manual_seed(0)
    return AttentionDarknet53(1, 0.125, "cbam_centred").eval()


def _masks(backbone):
    image = torch.rand(2, 1, 64, 64, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        return {name: mask[:, 0].numpy() for name, mask in backbone.attention_masks(image).items()}


def _changed(before, after):
    return {name[2] for name in before if not np.array_equal(before[name], after[name])}


def test_top_down_leaves_the_masks_below_and_bottom_up_changes_those_above(backbone):
    trained = _masks(backbone)
    down = {name: _changed(trained, _masks(one)) for name, one in cascade(backbone, "top_down", 7)}
    assert down == {
        "stage 5": {"5"},
        "stages 4-5": {"4", "5"},
        "stages 3-5": {"3", "4", "5"},
        "stages 2-5": {"2", "3", "4", "5"},
        "all": set("12345"),
    }
    steps = dict(cascade(backbone, "bottom_up", 7))
    assert list(steps) == ["stage 1", "stages 1-2", "stages 1-3", "stages 1-4", "all"]
    assert _changed(trained, _masks(steps["stage 1"])) == set("12345")
    # The original is unchanged, and so are the weights of the stages that are not randomised yet.
    assert _changed(trained, _masks(backbone)) == set()
    kept = "units.B_21.reduce.conv.weight"
    assert torch.equal(steps["stage 1"].state_dict()[kept], backbone.state_dict()[kept])


def test_both_directions_end_with_the_same_random_network(backbone):
    before = torch.get_rng_state()
    ends = [dict(cascade(backbone, direction, 7))["all"].state_dict() for direction in ("top_down", "bottom_up")]
    assert torch.equal(before, torch.get_rng_state())
    original = backbone.state_dict()
    for name, value in ends[0].items():
        assert torch.equal(value, ends[1][name])
        if name.endswith("conv.weight") or "spatial" in name or "excite" in name:
            assert not torch.equal(value, original[name])
    other = list(cascade(backbone, "bottom_up", 8))[-1][1].state_dict()
    assert not torch.equal(other["stem.conv.weight"], ends[0]["stem.conv.weight"])


@pytest.mark.parametrize("attention", ["cbam_identity", "cbam_centred"])
def test_randomised_gates_are_not_constant(attention):
    network = AttentionDarknet53(1, 0.125, attention).eval()
    _, random = list(cascade(network, "bottom_up", 0))[-1]
    assert min(found.std() for found in _masks(random).values()) > 1e-6


def test_deep_gates_of_the_plain_form_need_calibrated_batch_norms():
    network = AttentionDarknet53(1, 0.125, "cbam").eval()
    images = torch.rand(4, 1, 64, 64, generator=torch.Generator().manual_seed(2))
    _, plain = list(cascade(network, "bottom_up", 0))[-1]
    steps = dict(cascade(network, "bottom_up", 0, lambda changed: changed(images)))
    calibrated = steps["all"]
    assert _masks(plain)["B_54"].std() < 1e-6 < 1e-4 < _masks(calibrated)["B_54"].std()
    assert not any(module.training for module in calibrated.modules())
    with torch.no_grad():
        features = calibrated.stem.conv(images)
    torch.testing.assert_close(calibrated.stem.norm.running_mean, features.mean((0, 2, 3)))
    torch.testing.assert_close(calibrated.stem.norm.running_var, features.var((0, 2, 3)))
    # Stages that are not randomised keep their statistics.
    kept = steps["stage 1"].units["B_21"].reduce.norm
    assert not kept.running_mean.any() and kept.momentum == calibrated.stem.norm.momentum == 0.1


def test_a_network_is_randomised_and_restored(backbone):
    network, images = SimpleNamespace(backbone=backbone), np.zeros((2, 64, 64), np.uint8)
    table = randomised(network, lambda _: _masks(network.backbone), images, 7)
    assert network.backbone is backbone and len(table) == 2 * 5 * 23
    value = table.set_index(["direction", "step", "map"]).sort_index()
    assert value.loc[("top_down", "stage 5", "B_38"), "spearman"] == pytest.approx(1)
    assert value.loc[("bottom_up", "all", "B_11"), "spearman"] < 0.9
    ends = [value.loc[(direction, "all")] for direction in ("top_down", "bottom_up")]
    pd.testing.assert_frame_equal(*ends, atol=1e-4)


def test_similarity_agrees_with_scipy_and_torchmetrics():
    rng = np.random.default_rng(0)
    a = rng.random((2, 40, 48)).astype(np.float32)
    b = (0.6 * a + 0.4 * rng.random(a.shape)).astype(np.float32)
    row = similarity({"B_11": a}, {"B_11": b}, "stage 5").iloc[0]
    assert row["map"] == "B_11" and row["step"] == "stage 5"
    expected = [spearmanr(x.ravel(), y.ravel()).statistic for x, y in zip(a, b, strict=True)]
    assert row["spearman"] == pytest.approx(np.mean(expected))
    ssim = [
        structural_similarity_index_measure(
            *(torch.from_numpy(m[None, None]) for m in (y, x)), data_range=float(np.ptp(x))
        )
        for x, y in zip(a, b, strict=True)
    ]
    assert row["ssim"] == pytest.approx(float(np.mean(ssim)), abs=1e-4)


def test_similarity_of_equal_opposite_and_constant_masks():
    rng = np.random.default_rng(1)
    a = rng.random((3, 128, 96)).astype(np.float32)
    same = similarity({"B_11": a}, {"B_11": a}).iloc[0]
    assert same["spearman"] == pytest.approx(1) and same["ssim"] == pytest.approx(1)
    opposite = similarity({"B_11": a}, {"B_11": 1 - a}).iloc[0]
    assert opposite["spearman"] == pytest.approx(-1) and opposite["ssim"] < 0
    flat = np.full_like(a, 0.3) + np.float32(1e-8) * a
    assert np.isnan(similarity({"B_11": a}, {"B_11": flat})["spearman"].item())
    assert similarity({"B_11": flat}, {"B_11": a})[["spearman", "ssim"]].isna().all(axis=None)
