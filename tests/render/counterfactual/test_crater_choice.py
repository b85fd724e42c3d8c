"""The choice of frames and craters of a counterfactual."""

import numpy as np
import pandas as pd
import pytest
from tests.helpers.scenes import config_with

from perilune_render.config.dataset import KindConfig
from perilune_render.flight.counterfactual import choose_apart, part_of
from perilune_render.flight.plan import make_plan
from perilune_shared.errors import UserError


def plan():
    kind = KindConfig(
        n_scenes=10, trajectories_per_scene=2, n_frames=9, split_by="scene", val_share=0.1, test_share=0.2
    )
    return make_plan(config_with(detect=kind), "detect")


def test_frames_are_evenly_spaced_and_keep_their_poses():
    whole = plan()
    part = part_of(whole, "test", 3)
    assert len(part.scenes) == 2 and len(part.trajectories) == 4
    assert set(part.scenes) <= set(whole.scenes)
    for scene in part.scenes:
        for old, new in zip(whole.of_scene(scene.scene_id), part.of_scene(scene.scene_id), strict=True):
            assert new.frame_index == (0, 4, 8) and new.splits == ("test",) * 3
            assert [new.frame_id(place) for place in range(3)] == [old.frame_id(place) for place in (0, 4, 8)]
            assert np.array_equal(new.flight.position_m, old.flight.position_m[[0, 4, 8]])
            assert np.array_equal(new.flight.rotation_wxyz, old.flight.rotation_wxyz[[0, 4, 8]])
    assert part_of(whole, "test", 99).trajectories[0].frame_index == tuple(range(9))


def test_the_sun_turns_clockwise():
    part = part_of(plan(), "val", 2, -40.0)
    (old,) = (scene for scene in plan().scenes if scene.scene_id == part.scenes[0].scene_id)
    assert part.scenes[0].sun_azimuth_deg == pytest.approx((old.sun_azimuth_deg - 40) % 360)
    assert part.scenes[0].sun_elevation_deg == old.sun_elevation_deg


def test_a_split_without_frames_is_an_error():
    kind = KindConfig(n_scenes=1, trajectories_per_scene=1, n_frames=2, split_by="scene", val_share=0.0)
    with pytest.raises(UserError, match="no frame in val"):
        part_of(make_plan(config_with(detect=kind), "detect"), "val", 2)


def candidates(n, width_m):
    rng = np.random.default_rng(3)
    diameter = rng.uniform(5, 50, n)
    x, y = rng.uniform(-width_m, width_m, (2, n))
    ratio = rng.uniform(0.04, 0.2, n)
    columns = {"x_m": x, "y_m": y, "reach_m": 2 * diameter, "diameter_m": diameter, "depth_ratio": ratio}
    return pd.DataFrame(columns)


def test_craters_are_of_all_sizes_and_depths():
    table = candidates(600, 1e6)
    rows = table.iloc[choose_apart(table, 12, np.random.default_rng(1))]
    assert len(rows) == 12
    thirds = np.quantile(table["diameter_m"], [1 / 3, 2 / 3])
    for low, high in zip([0, *thirds], [*thirds, 99], strict=True):
        own = rows[rows["diameter_m"].between(low, high)]
        middle = table[table["diameter_m"].between(low, high)]["depth_ratio"].median()
        assert len(own) == 4 and (own["depth_ratio"] > middle).sum() == 2


def test_reaches_do_not_overlap_and_no_more_fit():
    table = candidates(60, 150)
    chosen = choose_apart(table, 60, np.random.default_rng(1))
    place, reach = table[["x_m", "y_m"]].to_numpy(), table["reach_m"].to_numpy()
    distance = np.hypot(*(place[:, None] - place[None]).transpose(2, 0, 1))
    overlap = distance < reach[:, None] + reach[None]
    assert 2 < len(chosen) < 60
    assert overlap[np.ix_(chosen, chosen)].sum() == len(chosen)  # each one with itself
    assert overlap[:, chosen].any(axis=1).all()


def test_the_choice_depends_on_the_seed_alone():
    table = candidates(200, 1e5)
    one, again, other = (choose_apart(table, 6, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert one == again != other
    assert choose_apart(table.iloc[:0], 6, np.random.default_rng(1)) == []
