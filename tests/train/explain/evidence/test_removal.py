"""Choice, replacement and effect of removed pixels, on images and maps that are known."""

import numpy as np
import pandas as pd
import pytest

from perilune_train.explain.evidence.removal import (
    PERFECT,
    block_means,
    chosen_pixels,
    random_like,
    relative_harm,
    removal_effect,
    removal_summary,
    removed,
    shifted_like,
)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def noise_image(rng, size=128):
    ramp = np.linspace(40, 200, size)
    return np.clip(ramp[None] + rng.normal(0, 10, (size, size)), 0, 255).astype(np.uint8)


def test_block_means_by_hand():
    np.testing.assert_array_equal(block_means(np.arange(16).reshape(4, 4), 2), [[2.5, 4.5], [10.5, 12.5]])


def test_blocks_at_the_edges_may_be_smaller(rng):
    np.testing.assert_array_equal(block_means(np.arange(15).reshape(3, 5), 2), [[3, 5, 6.5], [10.5, 12.5, 14]])
    image = noise_image(rng)[:67, :101]
    attended = rng.random(image.shape)
    chosen = chosen_pixels(attended, 0.2, "most", 1, rng)
    means, taken = block_means(attended, 8), block_means(chosen, 8)
    assert means.shape == (9, 13) and set(np.unique(taken)) == {0, 1}
    assert taken.sum() == round(0.2 * 9 * 13)
    assert means[taken == 1].min() > means[taken == 0].max()
    for moved in (random_like(image, chosen, rng), shifted_like(chosen, rng)):
        assert moved.shape == image.shape and block_means(moved, 8).sum() == taken.sum()
    effects = removal_effect(image[None], {"B_11": attended[None]}, {"B_11": 1}, lambda one: one.mean((1, 2)), rng)
    assert np.isfinite(effects["after"]).all()


@pytest.mark.parametrize(("which", "sign"), [("most", 1), ("least", 1), ("most", -1), ("least", -1)])
def test_the_chosen_blocks_have_the_extreme_means(which, sign, rng):
    map_ = rng.random((64, 128))
    chosen = chosen_pixels(map_, 0.2, which, sign, rng)
    assert chosen.sum() == round(0.2 * 8 * 16) * 64
    means, taken = block_means(sign * map_, 8), block_means(chosen, 8)
    assert set(np.unique(taken)) == {0, 1}
    if which == "most":
        assert means[taken == 1].min() > means[taken == 0].max()
    else:
        assert means[taken == 1].max() < means[taken == 0].min()


def test_ties_are_broken_at_random(rng):
    total = sum(chosen_pixels(np.full((64, 64), 2.0), 0.25, "most", 1, rng) for _ in range(400))
    # Each block is chosen in a quarter of 400 draws, with a standard deviation of 8.7.
    assert total.min() > 60 and total.max() < 140


def test_random_blocks_have_the_brightness_of_the_chosen_ones(rng):
    image = noise_image(rng)
    bright = chosen_pixels(image.astype(float), 0.2, "most", 1, rng)
    mixed = chosen_pixels(image + rng.normal(0, 1000, image.shape), 0.2, "most", 1, rng)
    for chosen in (bright, mixed):
        drawn = random_like(image, chosen, rng)
        assert drawn.sum() == chosen.sum()
        edges = np.quantile(image, np.linspace(0, 1, 6))
        shares = [np.histogram(image[one], edges)[0] / one.sum() for one in (drawn, chosen)]
        np.testing.assert_allclose(*shares, atol=0.06)
    assert (random_like(image, mixed, rng) != mixed).mean() > 0.1
    # Unmatched blocks of this image have another histogram.
    anywhere = image[chosen_pixels(rng.random((128, 128)), 0.2, "most", 1, rng)]
    assert abs(anywhere.mean() - image[bright].mean()) > 30


def test_shifted_blocks_keep_their_shape(rng):
    chosen = np.zeros((64, 128), bool)
    chosen[:8, :24] = chosen[8:16, :8] = True
    places = set()
    for _ in range(50):
        moved = shifted_like(chosen, rng)
        blocks = block_means(moved, 8)
        assert blocks.sum() == 4 and set(np.unique(blocks)) == {0, 1}
        # Three blocks in a row and one beside the first: of all rows of blocks one has three, one next to it one.
        rows = blocks.sum(axis=1)
        first = int(rows.argmax())
        assert rows[first] == 3 and rows[(first + 1) % 8] + rows[(first - 1) % 8] == 1
        places.add(moved.tobytes())
    assert len(places) > 30


def test_the_local_mean_by_hand():
    image = np.full((64, 64), 100, np.uint8)
    image[:, 32:] = 200
    chosen = np.zeros((64, 64), bool)
    chosen[8:16, :8] = chosen[8:16, 28:36] = True
    found = removed(image, chosen, "mean")
    np.testing.assert_array_equal(found[~chosen], image[~chosen])
    assert (found[8:16, :8] == 100).all()
    # The window of pixel (12, 32) has rows 0..27 and columns 17..47: 15 of 100, 16 of 200, less 8 rows of 4 and 4.
    expected = ((28 * 15 - 32) * 100 + (28 * 16 - 32) * 200) / (28 * 31 - 64)
    assert found[12, 32] == round(expected)
    # In a hole wider than the window the mean of the image's other pixels is used.
    hole = np.zeros((128, 128), bool)
    hole[32:96, 32:96] = True
    wide = np.where(hole, 255, 50).astype(np.uint8)
    assert (removed(wide, hole, "mean") == 50).all()


def test_inpainting_restores_a_smooth_image_and_removes_a_spot():
    image = np.tile(np.arange(64, dtype=np.uint8) * 2 + 50, (64, 1))
    spotted = image.copy()
    spotted[24:32, 24:32] = 255
    chosen = spotted == 255
    found = removed(spotted, chosen, "inpaint")
    np.testing.assert_array_equal(found[~chosen], image[~chosen])
    assert np.abs(found[chosen].astype(int) - image[chosen]).max() < 12
    with pytest.raises(ValueError, match="0 of 4096"):
        removed(image, np.zeros((64, 64), bool), "inpaint")


def test_only_the_removal_of_what_is_measured_hurts(rng):
    """The measure is the contrast of 13 spots, each as large as a block; one map attends to them."""
    images = np.full((3, 64, 64), 80, np.uint8) + rng.integers(0, 6, (3, 64, 64)).astype(np.uint8)
    blocks = np.zeros(64, bool)
    blocks[rng.permutation(64)[:13]] = True
    spots = blocks.reshape(8, 8).repeat(8, axis=0).repeat(8, axis=1)
    images[:, spots] += rng.choice([0, 120], (3, spots.sum())).astype(np.uint8)
    maps = {
        "follows": np.stack([spots] * 3) + rng.normal(0, 0.1, images.shape),
        "avoids": -1.0 * np.stack([spots] * 3) + rng.normal(0, 0.1, images.shape),
        "unrelated": rng.random(images.shape),
    }

    def contrast(changed):
        return changed[:, spots].std(axis=1)

    sign = {"follows": 1, "avoids": -1, "unrelated": 1}
    effects = removal_effect(images, maps, sign, contrast, rng)
    assert list(effects.columns) == ["map", "which", "how", "frame_index", "overlap", "before", "after"]
    assert len(effects) == 3 * 4 * 2 * 3
    np.testing.assert_allclose(effects["before"], np.tile(contrast(images), 24))
    overlaps = effects.groupby("which")["overlap"].mean()
    assert overlaps["most"] == 1 and overlaps["least"] == 0 and overlaps["shifted"] < 0.5
    table = removal_summary(effects, higher_is_better=True).set_index(["map", "how"])
    for how in ("inpaint", "mean"):
        for name in ("follows", "avoids"):
            row = table.loc[(name, how)]
            assert row["most"] > 20 and abs(row["least"]) < 1
            # "shifted" meets a fifth of the spots; "random" is of the same brightness, so of the spots.
            assert row["shifted"] < row["most"] / 2
        assert table.loc[("unrelated", how), "most"] < table.loc[("follows", how), "most"] / 2


def test_the_ratio_is_to_the_stronger_control():
    harms = {"most": [6, 8], "least": [0, 0], "random": [1, 3], "shifted": [1, 1]}
    rows = [
        {"map": "B_11", "which": which, "how": "mean", "frame_index": i, "before": 10.0, "after": 10.0 - harm}
        | {"overlap": 0.4 if which == "random" else 0.1}
        for which, pair in harms.items()
        for i, harm in enumerate(pair)
    ]
    effects = pd.DataFrame(rows)
    row = removal_summary(effects, higher_is_better=True).iloc[0]
    assert (row["map"], row["how"], row["control"]) == ("B_11", "mean", "random")
    assert [row["most"], row["least"], row["random"], row["shifted"], row["ratio"]] == [7, 0, 2, 1, 3.5]
    assert row["overlap"] == pytest.approx(0.4)
    errors = effects.assign(before=effects["after"], after=effects["before"])
    assert removal_summary(errors, higher_is_better=False)["ratio"].tolist() == [3.5]
    assert removal_summary(errors, higher_is_better=True)["ratio"].isna().all()


def test_without_a_defined_measure_there_are_rows_and_no_ratio():
    """AP is undefined in frames without labels; a map may have no other frames, or only in some removals."""
    kinds = ("most", "least", "random", "shifted")
    rows = [
        {"map": name, "which": which, "how": "mean", "frame_index": 0, "overlap": 0.3, "before": before}
        | {"after": after if which in defined else np.nan}
        for name, before, after, defined in (
            ("B_38", np.nan, 1.0, kinds),
            ("B_11", 3.0, 1.0, kinds),
            ("B_22", 3.0, 1.0, ("least", "random", "shifted")),
        )
        for which in kinds
    ]
    effects = pd.DataFrame(rows)
    table = removal_summary(effects, higher_is_better=True).set_index("map")
    assert list(table.index) == ["B_38", "B_11", "B_22"]
    assert table.loc["B_38", [*kinds, "ratio"]].isna().all() and table["overlap"].tolist() == [0.3] * 3
    assert table.loc["B_11", "ratio"] == 1 and np.isnan(table.loc["B_22", "ratio"])
    alone = removal_summary(effects[effects["map"] == "B_38"], higher_is_better=True)
    assert len(alone) == 1 and alone[[*kinds, "ratio"]].isna().all(axis=None)


def effects_of(harms, scenes=8):
    """Effects with one harm for each map and choice of pixels; scenes differ by a factor of mean 1."""
    factors = np.linspace(0.8, 1.2, scenes)
    return pd.DataFrame(
        [
            {"map": name, "which": which, "how": how, "scene_id": f"s{k}", "frame_id": f"s{k}/t/0"}
            | {"before": 1.0, "after": 1.0 - factors[k] * harm * (1 if how == "mean" else 2), "overlap": 0.2}
            for name, by_which in harms.items()
            for which, harm in by_which.items()
            for how in ("inpaint", "mean")
            for k in range(scenes)
        ]
    )


HARMS = {
    "B_38": {"most": 0.3, "least": 0.0, "random": 0.2, "shifted": 0.1},
    "edge/stage_3": {"most": 0.4},
    PERFECT: {"most": 0.5, "random": 0.1, "shifted": 0.2},
}


def test_harm_is_relative_to_the_stronger_control_to_edges_and_to_a_perfect_mask(rng):
    found = relative_harm(effects_of(HARMS), "B_38", "mean", True, rng)
    values = {name: ratio.value for name, ratio in found.items()}
    expected = {"control": 1.5, "edge/stage_3": 0.75, "perfect control": 2.5, PERFECT: 0.6}
    assert values == {name: pytest.approx(value) for name, value in expected.items()}
    # All scenes have these ratios, so the intervals have no width.
    for name, ratio in found.items():
        assert ratio.interval == (pytest.approx(values[name]), pytest.approx(values[name]))
    assert found["control"].p == 2**-8 and found["edge/stage_3"].p == 1
    assert np.isnan(found[PERFECT].p)


def test_a_relative_harm_without_a_perfect_mask_without_harm_and_with_few_scenes(rng):
    harmless = {"B_38": HARMS["B_38"] | {"random": 0.0, "shifted": 0.0}, "edge/stage_3": HARMS["edge/stage_3"]}
    found = relative_harm(effects_of(harmless, scenes=4), "B_38", "inpaint", True, rng)
    assert set(found) == {"control", "edge/stage_3"}
    assert np.isnan(found["control"].value) and found["edge/stage_3"].interval is None
    undefined = effects_of(HARMS).assign(before=np.nan)
    assert all(np.isnan(ratio.value) for ratio in relative_harm(undefined, "B_38", "mean", True, rng).values())


def test_edges_have_no_controls_and_a_perfect_mask_has_no_least(rng):
    images = np.stack([noise_image(rng, 64)] * 2)
    maps = {name: rng.random(images.shape) for name in ("B_38", "edge/stage_3", PERFECT)}
    effects = removal_effect(images, maps, dict.fromkeys(maps, 1), lambda changed: changed.std((1, 2)), rng)
    removals = effects.groupby("map")["which"].unique().map(set)
    assert removals["B_38"] == {"most", "least", "random", "shifted"}
    assert removals["edge/stage_3"] == {"most"} and removals[PERFECT] == {"most", "random", "shifted"}
    table = removal_summary(effects, higher_is_better=True).set_index("map")
    assert table.loc["edge/stage_3", ["random", "ratio", "overlap"]].isna().all(axis=None)
    assert np.isfinite(table.loc["edge/stage_3", "most"]).all() and np.isfinite(table.loc[PERFECT, "overlap"]).all()
