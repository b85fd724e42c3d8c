"""A scene that another processor began is resumed: numbers differ in their last digits, the content does not."""

import os
import subprocess
import sys
from dataclasses import replace

import pytest
from numpy.core._multiarray_umath import __cpu_dispatch__, __cpu_features__
from tests.helpers.scenes import config_with

from perilune_render.flight.plan import make_plan
from perilune_render.flight.view import view_envelope
from perilune_render.jobs.scene_renderer import write_scene
from perilune_render.terrain.scene import grow_scene
from perilune_shared.dataset.parts import read_part
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera

CAMERA = Camera.from_field_of_view(32, 32, 50.0)
CONFIG = config_with(terrain={"spacing_px": 2.0})
AVX512 = [name for name in __cpu_dispatch__ if name.startswith("AVX512") and __cpu_features__.get(name)]
BEGIN = """
import sys
from pathlib import Path
from tests.render.provenance.test_other_processor import begin
begin(Path(sys.argv[1]))
"""


def begin(out):
    plan = make_plan(CONFIG, "detect")
    scene = grow_scene(CONFIG, view_envelope(CAMERA, CONFIG.detect.flight), 3)
    write_scene(out, plan.scenes[0], scene, CONFIG, "0" * 16, plan.trajectories)
    return plan, scene


def test_a_scene_with_other_last_digits_is_resumed(tmp_path):
    plan, scene = begin(tmp_path)
    rims = replace(scene.rims, z_m=scene.rims.z_m * (1 + 1e-15), depth_m=scene.rims.depth_m * (1 - 1e-15))
    write_scene(tmp_path, plan.scenes[0], replace(scene, rims=rims), CONFIG, "0" * 16, plan.trajectories)
    other = replace(scene.rims, depth_m=scene.rims.depth_m + 0.01)
    with pytest.raises(UserError, match="other craters"):
        write_scene(tmp_path, plan.scenes[0], replace(scene, rims=other), CONFIG, "0" * 16, plan.trajectories)


@pytest.mark.skipif(not AVX512, reason="NumPy uses no AVX-512 here, so that the other processor cannot be had")
def test_a_scene_begun_on_another_processor_is_resumed(tmp_path):
    environment = {**os.environ, "NPY_DISABLE_CPU_FEATURES": " ".join(AVX512)}
    subprocess.run([sys.executable, "-c", BEGIN, str(tmp_path)], env=environment, check=True)
    part = tmp_path / "manifest/craters/scene-0000.parquet"
    old = read_part(part, "craters")
    begin(tmp_path)
    assert read_part(part, "craters").equals(old)
