"""Gates forced to their means."""

import numpy as np
import pandas as pd
import pytest
import torch

from perilune_train.explain.evidence.gates import ALL, forced, forced_gates, forced_summary, gate_means, scopes
from perilune_train.models.darknet import AttentionDarknet53


@pytest.fixture(scope="module")
def backbone():
    torch.manual_seed(0)
    return AttentionDarknet53(1, 0.125, "cbam_centred").eval()


def test_a_forced_gate_is_constant_and_is_released(backbone):
    x = torch.randn(2, 1, 64, 64)
    with torch.no_grad():
        before = backbone.attention_masks(x)
        features = [one.clone() for one in backbone(x)]
        with forced(backbone, {"B_21": 0.7}):
            masks, changed = backbone.attention_masks(x), backbone(x)
        after = backbone.attention_masks(x)
    assert torch.equal(masks["B_21"], torch.full_like(masks["B_21"], 0.7))
    assert torch.equal(masks["B_11"], before["B_11"]) and not torch.equal(masks["B_22"], before["B_22"])
    # Features before the gate stay, later ones change.
    assert torch.equal(changed[0], features[0]) and not torch.allclose(changed[4], features[4])
    assert all(torch.equal(after[block], before[block]) for block in before)


def test_a_gate_is_released_after_an_error(backbone):
    x = torch.randn(1, 1, 64, 64)
    with torch.no_grad():
        before = backbone.attention_masks(x)["B_11"]
        with pytest.raises(RuntimeError), forced(backbone, {"B_11": 0.0}):
            raise RuntimeError
        assert torch.equal(backbone.attention_masks(x)["B_11"], before)


def test_forcing_a_constant_gate_to_its_value_changes_nothing_and_others_do(backbone):
    """The measure is the mean feature of each image; identity gates are exactly 1 before training."""
    images = np.random.default_rng(0).integers(0, 255, (3, 64, 64), dtype=np.uint8)

    def measure_of(network):
        def measure(given):
            x = torch.from_numpy(given / 255.0).float()[:, None]
            with torch.no_grad():
                return network(x)[-1].mean((1, 2, 3)).double().numpy()

        return measure

    torch.manual_seed(0)
    identity = AttentionDarknet53(1, 0.125, "cbam_identity").eval()
    means = dict.fromkeys(identity.attentions, 1.0)
    table = forced_gates(identity, means, images, measure_of(identity), "test")
    np.testing.assert_array_equal(table["before"], table["after"])
    table = forced_gates(backbone, means, images, measure_of(backbone), "test")
    assert (table["before"] != table["after"]).all()
    assert table.groupby("scope").size().to_dict() == dict.fromkeys(scopes(list(means)), 3)


def test_scopes_are_gates_stages_with_several_gates_and_all():
    found = scopes(["B_11", "B_21", "B_22"])
    assert found == {
        "B_11": ("B_11",),
        "B_21": ("B_21",),
        "B_22": ("B_22",),
        "stage 2": ("B_21", "B_22"),
        ALL: ("B_11", "B_21", "B_22"),
    }
    assert gate_means({"B_11": np.array([[[0.0, 1.0]], [[1.0, 4.0]]], np.float32)}) == {"B_11": 1.5}


@pytest.mark.parametrize("higher_is_better", [True, False])
def test_the_harm_of_a_scope_has_an_interval_over_scenes_and_a_test(higher_is_better):
    rng = np.random.default_rng(1)
    rows = [
        {"scope": scope, "frame_id": f"s{scene}/t/{k}", "scene_id": f"s{scene}", "before": 1.0, "after": 1.0 - harm}
        for scope, mean in (("B_11", 0.2), (ALL, 0.0))
        for scene in range(8)
        for k, harm in enumerate(mean + rng.normal(0, 0.05, 3))
    ]
    table = pd.DataFrame(rows)
    if not higher_is_better:
        table = table.assign(before=table["after"], after=table["before"])
    found = forced_summary(table, higher_is_better, np.random.default_rng(0)).set_index("scope")
    harm = (table["before"] - table["after"]).abs()[table["scope"] == "B_11"]
    assert found.loc["B_11", "value"] == pytest.approx(harm.mean())
    assert found.loc["B_11", "low"] > 0.1 and found.loc["B_11", "high"] < 0.3
    assert found.loc["B_11", "p"] == 2**-8 and found.loc[ALL, "p"] > 0.05
    assert found["n_units"].tolist() == [8, 8]
    few = forced_summary(table[table["scene_id"] < "s4"], higher_is_better, np.random.default_rng(0))
    assert few["low"].isna().all()
