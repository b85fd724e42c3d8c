"""Which datasets share terrain, and which must not."""

import re

import numpy as np
import pytest
from tests.helpers.scenes import config_with

from perilune_render.config.dataset import CameraConfig, DatasetConfig, FlightConfig, KindConfig, SunConfig
from perilune_render.config.terrain import BouldersConfig, TerrainConfig
from perilune_render.dataset.begin import new_info
from perilune_render.dataset.from_manifest import plan_from_manifest
from perilune_render.dataset.tables import ground_tables
from perilune_render.flight.plan import make_plan
from perilune_render.flight.view import view_envelope
from perilune_render.provenance.recipe import recipe_of
from perilune_render.terrain.scene import grow_scene
from perilune_shared.config.resolve import PRESETS, resolve
from perilune_shared.content import content_sha256
from perilune_shared.dataset.manifest import Dataset, open_dataset
from perilune_shared.dataset.metadata import recipes_of
from perilune_shared.errors import UserError

COARSE = TerrainConfig(spacing_px=3.0, boulders=BouldersConfig(density=0.0))
LOW = FlightConfig(start_altitude_m=300.0, end_altitude_m=200.0, downrange_m=50.0)


def preset(name, *settings) -> DatasetConfig:
    return resolve(DatasetConfig, "dataset", "perilune_render", name, None, settings)


def cheap(**changes) -> DatasetConfig:
    """Small ground for two kinds that differ in their attitude, as those of `paper` do."""
    detect = KindConfig(
        n_scenes=1,
        trajectories_per_scene=2,
        n_frames=4,
        split_by="frame",
        flight=LOW.model_copy(update={"attitude_sigma_deg": 1.0, "position_sigma_m": 2.0}),
    )
    nav = KindConfig(n_scenes=1, trajectories_per_scene=2, n_frames=4, split_by="trajectory", flight=LOW)
    camera = CameraConfig(width_px=64, height_px=64)
    return config_with(detect=detect, nav=nav, terrain=COARSE, camera=camera, **changes)


def ground_sha256(config: DatasetConfig, kind: str, flight: FlightConfig | None = None) -> str:
    plan = make_plan(config, kind)
    scene = grow_scene(
        config, view_envelope(plan.exr_camera, flight or config.ground_flight(kind)), plan.scenes[0].seed
    )
    assert len(scene.craters) > 10
    tables = ground_tables("scene-0000", scene)
    return content_sha256(tables["craters"], tables["boulders"])


def test_every_preset_has_its_own_name():
    assert [preset(name).name for name in PRESETS] == list(PRESETS)


def test_no_two_presets_share_a_scene_seed():
    seeds = {}
    for name in PRESETS:
        for kind in ("detect", "nav"):
            # Descents take time to draw and have no part in a scene's seed.
            config = preset(name, f"dataset.{kind}.trajectories_per_scene=1", f"dataset.{kind}.n_frames=2")
            for scene in make_plan(config, kind).scenes:
                seeds.setdefault(scene.seed, set()).add((name, kind))
    shared = [users for users in seeds.values() if len(users) > 1]
    assert shared == [{("paper", "detect"), ("paper", "nav")}]


def test_equal_settings_under_two_names_grow_different_ground():
    hashes = {ground_sha256(cheap(name=name), kind) for name in ("small", "large") for kind in ("detect", "nav")}
    assert len(hashes) == 4


def test_shared_terrain_gives_both_kinds_one_ground_and_one_sun():
    config = cheap(shared_terrain=True)
    detect, nav = make_plan(config, "detect"), make_plan(config, "nav")
    assert detect.scenes == nav.scenes
    assert ground_sha256(config, "detect") == ground_sha256(config, "nav")
    # By its own flight alone a kind would get another grid, and with it other craters.
    assert ground_sha256(config, "detect", config.detect.flight) != ground_sha256(config, "nav", config.nav.flight)
    for one in detect.trajectories:
        for other in nav.trajectories:
            assert not np.allclose(one.flight.position_m, other.flight.position_m, atol=0.1)


def test_shared_ground_reaches_as_far_as_either_kind_needs():
    config = cheap(shared_terrain=True)
    covering = config.ground_flight("nav")
    assert covering == config.ground_flight("detect")
    assert (covering.attitude_sigma_deg, covering.position_sigma_m) == (1.0, 8.0)


def test_the_papers_kinds_share_their_scene():
    config = preset("paper", "dataset.detect.trajectories_per_scene=1", "dataset.nav.trajectories_per_scene=1")
    detect, nav = make_plan(config, "detect"), make_plan(config, "nav")
    assert detect.scenes == nav.scenes
    assert config.ground_flight("detect") == config.ground_flight("nav")
    assert detect.trajectories[0].seed != nav.trajectories[0].seed


@pytest.mark.parametrize(
    ("nav", "named"),
    [
        ({"sun": SunConfig(elevation_deg={"low": 5.0, "high": 6.0})}, "nav.sun"),
        ({"flight": LOW.model_copy(update={"start_altitude_m": 900.0})}, "start_altitude_m"),
    ],
)
def test_shared_terrain_refuses_kinds_that_need_different_scenes(nav, named):
    first = cheap().nav
    with pytest.raises(ValueError, match=re.escape(named)):
        config_with(detect=first, nav=first.model_copy(update=nav), shared_terrain=True)


def test_a_datasets_name_follows_the_key():
    config = preset("tiny", "dataset.name=crater-field")
    info = new_info(config, make_plan(config, "detect"), recipe_of(config, "detect", "tiny"))
    assert info.name == "perilune-crater-field-detect"


@pytest.mark.parametrize("name", ["", "a b", "../up", "x" * 61, "-x"])
def test_a_name_is_plain(name):
    with pytest.raises(UserError, match=r"dataset\.name"):
        preset("tiny", f"dataset.name={name!r}")


def test_a_manifest_rendered_again_keeps_its_seeds(quick):
    manifest = open_dataset(quick / "detect")
    recipe = manifest.info.recipe()
    renamed = recipe.model_copy(update={"config": {**recipe.config, "name": "other"}})
    info = manifest.info.model_copy(update={"recipes": recipes_of(renamed)})
    plan, config, begun = plan_from_manifest(Dataset(manifest.store.folder, info))
    stated = manifest.table("scenes").sort_by("scene_id")["seed"].to_pylist()
    assert [scene.seed for scene in plan.scenes] == stated
    assert stated != [scene.seed for scene in make_plan(config, "detect").scenes]
    assert begun.name == manifest.info.name
