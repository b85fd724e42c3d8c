"""What a rendering may go on with, and what it must not touch. Nothing is rendered here."""

import os
from dataclasses import replace

import pytest
from rich.progress import Progress
from tests.helpers.drawn_dataset import build_dataset
from tests.helpers.scenes import config_with

from perilune_render.config.dataset import KindConfig
from perilune_render.config.terrain import TerrainConfig
from perilune_render.dataset.begin import begin_or_resume, new_info
from perilune_render.dataset.develop import develop_dataset
from perilune_render.dataset.regenerate import png_outlier_share, regenerate
from perilune_render.flight.plan import make_plan
from perilune_render.jobs import run
from perilune_render.jobs.in_process import InProcess
from perilune_render.jobs.job import Job
from perilune_render.jobs.run import render_job
from perilune_render.provenance.recipe import config_of, recipe_of, same_source
from perilune_shared.dataset.info_file import write_info
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.editing.subset import subset
from perilune_shared.errors import UserError
from perilune_shared.storage.locks import locked
from perilune_shared.storage.store import open_store


@pytest.fixture
def drawn(tmp_path):
    return build_dataset(tmp_path / "drawn", "detect", side_px=32, splits={"train": 1}, n_frames=2, craters=30)


@pytest.fixture
def begun(tmp_path):
    """A job of one recorded descent, and the folder in which its dataset is begun."""
    config = config_with()
    plan = make_plan(config, "detect")
    plan = replace(plan, trajectories=tuple(replace(descent, is_drawn=False) for descent in plan.trajectories))
    job = Job(plan, config, new_info(config, plan, recipe_of(config, "detect", "tiny")), "configuration")
    run.prepare(job, open_store(tmp_path), lambda scene_id: None)
    return job, tmp_path


def test_a_rendering_goes_on_with_its_own_plan_alone(begun):
    job, out = begun
    run.prepare(job, open_store(out), lambda scene_id: None)
    (descent,) = job.plan.trajectories
    moved = replace(descent.flight, position_m=descent.flight.position_m + 1.0)
    for other in (
        replace(descent, draw_flight=lambda: moved),
        replace(descent, splits=("test",) * len(descent.splits)),
        replace(descent, frame_index=tuple(i + 1 for i in descent.frame_index)),
        replace(descent, trajectory_id="trajectory-0009"),
        replace(descent, seed=descent.seed + 1),
    ):
        changed = replace(job, plan=replace(job.plan, trajectories=(other,)))
        with pytest.raises(UserError, match=r"plan\.json: plan: got the plan of another dataset"):
            run.prepare(changed, open_store(out), lambda scene_id: None)


def test_a_manifest_is_not_rendered_into_itself(tmp_path):
    config = config_with()
    info = new_info(config, make_plan(config, "detect"), recipe_of(config, "detect", "tiny"))
    write_info(tmp_path, info.model_copy(update={"images": "planned", "complete": True}))
    with pytest.raises(UserError, match="planned"):
        begin_or_resume(open_store(tmp_path), info)


def test_a_folder_that_another_process_writes_is_left_alone(begun):
    job, out = begun
    before = sorted(out.rglob("*"))
    with locked(out), pytest.raises(UserError, match=f"locked by PID {os.getpid()} "):
        render_job(job, out, Progress(), InProcess)
    assert sorted(out.rglob("*")) == before


def test_frames_are_not_made_again_over_a_dataset(drawn):
    with pytest.raises(UserError, match="would be replaced"):
        regenerate(open_dataset(drawn), ["s000/t000/000000"], drawn, Progress())


def test_what_has_no_exrs_is_not_developed(drawn, tmp_path):
    with pytest.raises(UserError, match="exr"):
        develop_dataset(open_dataset(drawn), tmp_path / "out", Progress())
    subset(open_dataset(drawn), tmp_path / "plan", images="plan")
    with pytest.raises(UserError, match="exr"):
        develop_dataset(open_dataset(tmp_path / "plan"), tmp_path / "out", Progress())
    assert not (tmp_path / "out").exists()


def test_settings_that_change_no_byte_are_no_part_of_the_recipe():
    recipe = recipe_of(config_with(), "detect", "tiny")
    nav = {**config_with().nav.model_dump(), "n_frames": 77}
    assert recipe_of(config_with(render={"threads": 3, "cache_gib": 1.0}, nav=nav), "detect", "tiny").key == recipe.key
    assert recipe_of(config_with(render={"samples": 9}), "detect", "tiny").key != recipe.key
    assert config_of(recipe, "dataset.json") == config_with()


def test_another_release_with_the_same_code_resumes(tmp_path):
    config = config_with()
    recipe = recipe_of(config, "detect", "tiny")
    old = recipe.model_copy(update={"versions": {**recipe.versions, "perilune_render": "0.0.1"}})
    plan = make_plan(config, "detect")
    write_info(tmp_path, new_info(config, plan, old))
    assert begin_or_resume(open_store(tmp_path), new_info(config, plan, recipe)).recipe() == old
    other = recipe.model_copy(update={"versions": {**recipe.versions, "opencv": "0.0.1"}})
    with pytest.raises(UserError, match="opencv"):
        begin_or_resume(open_store(tmp_path), new_info(config, plan, other))


def test_settings_that_are_none_are_refused(drawn):
    recipe = open_dataset(drawn).info.recipe().model_copy(update={"config": {"terrain": 5}})
    with pytest.raises(UserError, match="terrain"):
        config_of(recipe, "dataset.json")


def test_an_elevation_model_goes_by_its_content():
    assert same_source("a.tif sha256:12", "b.tif sha256:12")
    assert not same_source("a.tif sha256:12", "a.tif sha256:13") and not same_source("procedural", "a.tif sha256:12")


def test_what_is_no_picture_is_far_from_one(drawn):
    png = (drawn / "frames/s000/t000/000000.png").read_bytes()
    assert png_outlier_share(png, png) == 0 and png_outlier_share(b"no picture", png) == 1


def test_scenes_over_one_elevation_model_share_terrain():
    scenes = KindConfig(n_scenes=3, trajectories_per_scene=1, n_frames=4, split_by="scene")
    for dem, expected in ((None, "scene"), ("a.tif", "trajectory")):
        config = config_with(detect=scenes, terrain=TerrainConfig(dem=dem))
        info = new_info(config, make_plan(config, "detect"), recipe_of(config, "detect", "tiny"))
        assert info.split_by == expected
