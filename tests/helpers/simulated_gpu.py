"""Render tiny frames on the processor and on the CUDA device that numba simulates; write all of them to an NPZ file.

NUMBA_ENABLE_CUDASIM=1 python -m tests.helpers.simulated_gpu OUT
"""

import sys
from dataclasses import replace

import numpy as np

from benchmarks.scene.truth import CAMERA, POSES, pose
from perilune_render.config.dataset import LightConfig, RenderConfig
from perilune_render.config.terrain import BouldersConfig, TerrainConfig
from perilune_render.engines.heightfield.engine import HeightfieldEngine
from perilune_render.engines.heightfield.gpu import CudaEngine
from perilune_render.flight.sub_poses import RowPoses
from perilune_render.flight.view import view_envelope
from perilune_render.terrain.scene import grow_scene
from perilune_shared.geometry.frames import sun_direction
from tests.helpers.scenes import config_with

SIDE_PX = 16
SEEDS = (1, 2, 3)
LAWS = ("hapke_mean", "lommel_seeliger", "lunar_lambert", "lambert")
FIELDS = ("radiance_factor", "depth_m", "normal", "sunlit")


def main(out: str) -> None:
    scale = SIDE_PX / CAMERA.width_px
    middle = {"cx_px": SIDE_PX / 2, "cy_px": SIDE_PX / 2}
    focal = {"fx_px": CAMERA.fx_px * scale, "fy_px": CAMERA.fy_px * scale}
    camera = replace(CAMERA, width_px=SIDE_PX, height_px=SIDE_PX, **focal, **middle)
    terrain = TerrainConfig(spacing_px=1.0, boulders=BouldersConfig(density=10.0))
    config = config_with(terrain=terrain, render=RenderConfig(samples=2, threads=1))
    scene = grow_scene(config, view_envelope(CAMERA, config.detect.flight), 3)
    sun = sun_direction(60, 20)
    poses = [pose(scene, *place) for place in POSES[: len(SEEDS)]]
    stacked = [np.stack(part) for part in zip(*poses, strict=True)]
    found: dict[str, np.ndarray] = {}
    surface = None
    for law in LAWS:
        lit = config.model_copy(update={"light": LightConfig(photometry=law)})
        cpu = HeightfieldEngine(scene, lit, camera, sun, surface=surface)
        surface = cpu.surface
        gpu = CudaEngine(scene, lit, camera, sun, surface)
        batch = gpu.render_batch(*stacked, SEEDS)
        for k, (seed, each) in enumerate(zip(SEEDS, batch.to_host(), strict=True)):
            expected = cpu.render(*poses[k], seed)
            for name in FIELDS:
                found[f"{law}.{k}.{name}.cpu"] = getattr(expected, name)
                found[f"{law}.{k}.{name}.gpu"] = getattr(each, name)
    found["dlpack"] = np.from_dlpack(batch.radiance_factor)
    found["batch"] = batch.radiance_factor.to_host()
    # A rolling shutter, and a part of an image that is rendered again.
    position, rotation = poses[0]
    rows = np.repeat(np.arange(SIDE_PX)[:, None], SIDE_PX, axis=1)
    moving = RowPoses(rows, 0.01 * np.arange(SIDE_PX), lambda t: (position + np.array([40.0 * t, 0, 0]), rotation))
    wanted = np.zeros((SIDE_PX, SIDE_PX), bool)
    wanted[3, 4] = True
    for name, engine in (("cpu", cpu), ("gpu", gpu)):
        whole = engine.render(position, rotation, 5)
        found[f"rows.{name}"] = engine.render_rows(moving, 5).radiance_factor
        found[f"again.{name}"] = engine.render_again(whole, wanted, position, rotation, 5).radiance_factor
    np.savez(out, **found)


if __name__ == "__main__":
    main(sys.argv[1])
