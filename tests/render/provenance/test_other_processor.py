"""Bytes do not depend on processor and number of threads; a scene with other last digits is resumed all the same."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from tests.helpers.other_processor import OTHER_PROCESSOR
from tests.helpers.scenes import config_with
from tests.sampling import every

from perilune_render.dataset import tables
from perilune_render.dataset.work import write_scene
from perilune_render.flight.plan import make_plan
from perilune_render.flight.view import view_envelope
from perilune_render.terrain.scene import grow_scene
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.storage.store import open_store

CAMERA = Camera.from_field_of_view(32, 32, 50.0)
CONFIG = config_with(terrain={"spacing_px": 2.0})
SMALL = (
    "dataset.camera={width_px: 64, height_px: 48, distortion: {k1: -0.05}}",
    "dataset.terrain.spacing_px=1.0",
    "dataset.detect.n_scenes=1",
    "dataset.detect.n_frames=3",
)


def rendered(out, workers, threads, environment):
    """The content of each file of a small dataset; its ground is not taken from a cache."""
    command = [str(Path(sys.executable).parent / "perilune-render"), "dataset", "--preset", "tiny", "--kind", "detect"]
    command += ["--workers", str(workers)]
    settings = [f"--set={setting}" for setting in (*SMALL, f"dataset.render.threads={threads}")]
    command += [*settings, "--out", str(out / "made")]
    subprocess.run(
        command,
        check=True,
        capture_output=True,
        text=True,
        env={**os.environ, **environment, "PERILUNE_CACHE": str(out / "scenes")},
    )
    return {p.relative_to(out).as_posix(): p.read_bytes() for p in (out / "made").rglob("*") if p.is_file()}


@pytest.mark.slow
def test_a_dataset_has_the_same_bytes_on_another_processor_with_more_threads(tmp_path):
    one = rendered(tmp_path / "one", 0, 1, {})
    two = rendered(tmp_path / "two", 1, 2, OTHER_PROCESSOR)
    assert len(one) > 10 and open_dataset(tmp_path / "one/made/detect").info.counts.labels > 30
    assert sorted(one) == sorted(two)
    assert [name for name in one if one[name] != two[name]] == []


RECIPE = """
{first}
from tests.helpers.scenes import config_with
from perilune_render.provenance.recipe import recipe_of
print(recipe_of(config_with(), "detect", "tiny").versions.get("arithmetic"))
"""


@pytest.mark.parametrize(
    ("first", "arithmetic"), every(2, [("import numpy", "of the processor"), ("import perilune_render, numpy", "None")])
)
def test_a_recipe_says_if_numpy_came_before_perilune(first, arithmetic):
    bare = {name: value for name, value in os.environ.items() if not name.startswith(("NPY_", "NUMBA_"))}
    command = [sys.executable, "-c", RECIPE.format(first=first)]
    printed = subprocess.run(command, env=bare, check=True, capture_output=True, text=True).stdout
    assert printed.strip() == arithmetic


def test_a_scene_with_other_last_digits_is_resumed(tmp_path):
    (planned,) = (plan := make_plan(CONFIG, "detect")).scenes
    scene = grow_scene(CONFIG, view_envelope(CAMERA, CONFIG.detect.flight), 3)

    def write(ground):
        rows = tables.scene_tables(planned, ground, CONFIG, "0" * 16)
        trajectories = tables.trajectory_table(plan.of_scene(planned.scene_id))
        write_scene(open_store(tmp_path), planned.scene_id, {**rows, "trajectories": trajectories})

    write(scene)
    rims = replace(scene.rims, z_m=scene.rims.z_m * (1 + 1e-15), depth_m=scene.rims.depth_m * (1 - 1e-15))
    write(replace(scene, rims=rims))
    other = replace(scene.rims, depth_m=scene.rims.depth_m + 0.01)
    with pytest.raises(UserError, match="other craters"):
        write(replace(scene, rims=other))
