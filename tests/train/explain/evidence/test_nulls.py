import numpy as np
import pytest

from perilune_train.explain.correlation.measures import FrameTargets, PairTargets
from perilune_train.explain.correlation.pearson import pearson
from perilune_train.explain.evidence.nulls import detector_nulls, other_rows, pair_nulls, renamed
from perilune_train.explain.maps.baselines import baseline_maps

_SCENES = [f"s{n // 2}" for n in range(8)]
_NAMES = [f"s{n // 2}/t/{n}" for n in range(8)]


def _images(seed=0, count=8, size=64):
    return np.random.default_rng(seed).integers(0, 256, (count, size, size), np.uint8)


def test_other_rows_are_of_other_scenes():
    rng = np.random.default_rng(0)
    for _ in range(20):
        assert all(_SCENES[n] != _SCENES[m] for n, m in enumerate(other_rows(_SCENES, rng)))
        assert all(n != m for n, m in enumerate(other_rows(["s"] * 5, rng)))
    with pytest.raises(ValueError, match="1 frames"):
        other_rows(["s"], rng)


def test_detector_nulls_have_every_null_and_the_values_of_their_maps():
    rng = np.random.default_rng(1)
    images, truth = _images(), rng.random((8, 64, 64))
    masks, untrained = ({"B_11": rng.random((8, 64, 64)), "B_31": rng.random((8, 64, 64))} for _ in range(2))
    common = FrameTargets(truth, *rng.random((2, 8, 64, 64)), _NAMES, _SCENES)
    table = detector_nulls(images, masks, untrained, common, np.random.default_rng(5))
    assert (table["kind"] == "null").all()
    stages = {f"{one}/stage_{k}" for one in ("edge", "contrast", "brightness") for k in range(1, 6)}
    gates = {f"{one}/{gate}" for one in ("untrained", "other frame") for gate in masks}
    assert set(table["map"]) == stages | gates
    assert set(table.loc[table["map"].str.startswith("other"), "measure"]) == {
        "pcc1_background",
        "pcc1_craterness",
        "pcc1_partial",
    }
    value = table.set_index(["map", "measure", "frame_id"])["value"]
    edge = baseline_maps(images)["edge/stage_2"]
    assert value["edge/stage_2", "pcc1_background", _NAMES[3]] == pytest.approx(pearson(edge[3], truth[3]))
    other = other_rows(_SCENES, np.random.default_rng(5))
    expected = pearson(masks["B_31"][other[4]], truth[4])
    assert value["other frame/B_31", "pcc1_background", _NAMES[4]] == pytest.approx(expected)


def test_pair_nulls_of_a_still_camera():
    rng = np.random.default_rng(2)
    images = _images(3)
    masks = {"B_11": np.tile(rng.random((8, 64, 64)), (1, 2, 1))}
    untrained = {"B_11": rng.random((8, 128, 64))}
    pairs, targets = np.concatenate([images, images], axis=1), PairTargets([np.eye(3)] * 8, _NAMES, _SCENES)
    table = pair_nulls(pairs, masks, untrained, targets, np.random.default_rng(5))
    means = table.groupby(["map", "measure"])["value"].mean()
    # The same image twice, without motion; halves of different pairs are independent noise.
    assert means["edge/stage_1", "pcc3"] == pytest.approx(1) and means["brightness/stage_3", "pcc4"] == pytest.approx(1)
    assert abs(means["other pair/B_11", "pcc4"]) < 0.03 and abs(means["untrained/B_11", "pcc3"]) < 0.03
    assert len(table) == (15 + 2) * 3 * 8


def test_one_frame_has_no_other_frame():
    """As the validation split of a tiny dataset: the null is undefined, and nothing fails."""
    rng = np.random.default_rng(1)
    masks = {"B_11": rng.random((1, 64, 64))}
    common = FrameTargets(rng.random((1, 64, 64)), *rng.random((2, 1, 64, 64)), ["s/t/0"], ["s"])
    table = detector_nulls(_images(count=1), masks, masks, common, rng)
    assert table.loc[table["map"] == "other frame/B_11", "value"].isna().all()
    assert table.loc[(table["map"] == "edge/stage_1") & (table["measure"] == "pcc1_craterness"), "value"].notna().all()
    stacked = {"B_11": rng.random((1, 128, 64))}
    pair = np.concatenate([_images(count=1), _images(seed=1, count=1)], axis=1)
    table = pair_nulls(pair, stacked, stacked, PairTargets([np.eye(3)], ["s/t/0"], ["s"]), rng)
    assert table.loc[table["map"] == "other pair/B_11", "value"].isna().all()


def test_renamed_nulls_belong_to_their_gate():
    assert list(renamed("untrained", {"B_11": np.zeros((1, 2, 2), np.float32)})) == ["untrained/B_11"]
