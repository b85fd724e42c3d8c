"""Random sequences of merge, subset, split, migrate and pack: every result is consistent."""

import itertools
import os
from pathlib import Path

import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.helpers.drawn_dataset import build_dataset

from perilune_shared.dataset.manifest import count_rows, open_dataset
from perilune_shared.editing.merge import merge
from perilune_shared.editing.migrate import migrate
from perilune_shared.editing.pack import pack, unpack
from perilune_shared.editing.split import Split, split_dataset
from perilune_shared.editing.subset import Limit, subset
from perilune_shared.errors import UserError
from perilune_shared.export.stats import summary
from perilune_shared.validation.validate import validate

OLD = Path(__file__).parents[1] / "old"
CHAINS = int(os.environ.get("PERILUNE_CHAINS", "60"))
"""Number of random chains of the slow test, the same ones each time.

1000 take minutes and reach no line and no branch more than 200.
"""
CONDITIONS = (
    "frame_index % 2 == 0",
    "split == 'train'",
    "split != 'test'",
    "trajectories.seed != 1",
    "depth_m > 2 and radius_px < 30",
)
STEPS = st.one_of(
    st.tuples(st.just("merge"), st.integers(0, 3)),
    st.tuples(st.just("where"), st.sampled_from(CONDITIONS)),
    st.tuples(st.just("frames"), st.sampled_from([3, 5])),
    st.tuples(st.just("split"), st.sampled_from(["scene", "trajectory", "frame"]), st.just(0)),
    st.tuples(st.just("migrate"), st.sampled_from(["1", "2"])),
    st.tuples(st.just("pack")),
)


class Pool:
    """Cache of datasets by the steps that made them; each is made and checked once."""

    def __init__(self, root: Path):
        self.root, self.numbers = root, itertools.count()
        self.made: dict[tuple, Path | None] = {}
        for seed in (1, 2):
            splits = {"train": 1, "val": 1, "test": 1}
            # More trajectories than terrains, so that not every split is by scene.
            self.made["drawn", seed] = build_dataset(
                root / f"drawn{seed}",
                "detect",
                side_px=64,
                splits=splits,
                scenes=seed,
                n_frames=2,
                craters=30,
                seed=seed,
            )

    def of(self, key: tuple, make) -> Path | None:
        """Return the dataset of a key, or None if it was refused with one line; then no file is left."""
        if key not in self.made:
            out = self.root / str(next(self.numbers))
            try:
                make(out)
                self.made[key] = out
                check(out)
            except UserError as error:
                assert "\n" not in str(error) and not out.exists()
                self.made[key] = None
        return self.made[key]


def check(root: Path) -> None:
    dataset = open_dataset(root)
    assert validate(dataset) == []
    assert dataset.info.counts == count_rows(dataset)
    frames, labels = dataset.table("frames").to_pandas(), dataset.table("labels").to_pandas()
    rows = summary(dataset).set_index("split")
    assert rows["frames"].to_dict() == frames["split"].value_counts().to_dict()
    assert rows["labels"].sum() == len(labels)
    terrain = frames.merge(dataset.table("scenes").to_pandas(), on="scene_id")
    shared = {
        "scene": terrain.groupby("content_sha256")["split"].nunique().max() > 1,
        "trajectory": frames.groupby(["scene_id", "trajectory_id"])["split"].nunique().max() > 1,
    }
    expected = "frame" if shared["trajectory"] else "trajectory" if shared["scene"] else "scene"
    assert dataset.info.split_by == expected
    trajectories = dataset.table("trajectories").to_pandas().set_index(["scene_id", "trajectory_id"])["n_frames"]
    counted = frames.groupby(["scene_id", "trajectory_id"]).size()
    pd.testing.assert_series_equal(trajectories.sort_index(), counted.sort_index(), check_names=False)


def step(pool: Pool, key: tuple, folder: Path, earlier: list[tuple[tuple, Path]], what: tuple) -> tuple:
    """Return key and folder of the next dataset of a chain; the given ones if the step is refused."""
    name, *detail = what
    new = (*key, what)
    if name == "merge":
        other, place = earlier[detail[0] % len(earlier)]
        new = ("merge", key, other)
        made = pool.of(new, lambda out: merge([open_dataset(folder), open_dataset(place)], out))
    elif name == "where":
        made = pool.of(new, lambda out: subset(open_dataset(folder), out, detail))
    elif name == "frames":
        made = pool.of(new, lambda out: subset(open_dataset(folder), out, limit=Limit(n_frames=detail[0])))
    elif name == "split":
        made = pool.of(new, lambda out: split_dataset(open_dataset(folder), out, Split(detail[0], 0.2, 0.2, detail[1])))
    elif name == "migrate":
        new = ("old", detail[0])
        made = pool.of(new, lambda out: migrate(OLD / detail[0], out))
    else:
        act = unpack if open_dataset(folder).info.images == "packed" else pack
        made = pool.of(new, lambda out: act(open_dataset(folder), out))
    return (new, made) if made is not None else (key, folder)


@pytest.fixture(scope="module")
def pool(tmp_path_factory):
    return Pool(tmp_path_factory.mktemp("chains"))


@pytest.mark.parametrize("n_chains", [6, pytest.param(CHAINS, marks=pytest.mark.slow)])
def test_every_result_of_a_chain_is_consistent(pool, n_chains):
    chains = []

    @settings(max_examples=n_chains, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
    @given(st.sampled_from([1, 2]), st.lists(STEPS, min_size=1, max_size=3))
    def run(start, steps):
        key, folder = ("drawn", start), pool.made["drawn", start]
        earlier = [(("drawn", n), pool.made["drawn", n]) for n in (1, 2)]
        for what in steps:
            key, folder = step(pool, key, folder, earlier, what)
            earlier.append((key, folder))
        chains.append(len(steps))

    run()
    made = [folder for folder in pool.made.values() if folder is not None]
    assert len(chains) >= n_chains and len(made) > n_chains / 5
