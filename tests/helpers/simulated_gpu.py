"""Render tiny frames on the processor and on the CUDA device that numba simulates; write all of them to an NPZ file.

NUMBA_ENABLE_CUDASIM=1 python -m tests.helpers.simulated_gpu OUT
"""

import sys
from dataclasses import replace

import numpy as np
import pandas as pd

from benchmarks.scene.truth import CAMERA, POSES, pose
from perilune_render.config.dataset import LabelsConfig, LightConfig, RenderConfig
from perilune_render.config.terrain import BouldersConfig, TerrainConfig
from perilune_render.dataset.tables import label_table
from perilune_render.engines.frame_source import FrameSource, Shot
from perilune_render.engines.heightfield.engine import HeightfieldEngine
from perilune_render.engines.heightfield.gpu import CudaEngine
from perilune_render.engines.heightfield.gpu_frames import CudaSource
from perilune_render.flight.sub_poses import RowPoses
from perilune_render.flight.view import view_envelope
from perilune_render.imaging.sensor import expected
from perilune_render.labels.frame_labels import RimCircles
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
    found |= frames_of_both(cpu, gpu, config, camera, RimCircles.of_scene(scene), poses)
    np.savez(out, **found)


def frames_of_both(cpu, gpu, config, camera, circles, poses) -> dict[str, np.ndarray]:
    """Images and labels by the sensor on both devices, for a camera at rest and a moving camera."""
    found: dict[str, np.ndarray] = {}
    for name, speed_mps, bits in (("rests", 0.0, 8), ("moves", 600.0, 12)):
        sensor = config.sensor.model_copy(
            update={"bits": bits, "dark_current_e_per_s": 2000.0, "black_level_share": 0.05}
        )
        sized = config.model_copy(update={"sensor": sensor, "labels": LabelsConfig(min_radius_px=0.3)})
        shots = [Shot(*each, np.array([speed_mps, 50.0, 0.0]) * (speed_mps > 0), 9, k) for k, each in enumerate(poses)]
        source = FrameSource.of(cpu, sized, camera, circles)
        on_device = CudaSource(FrameSource.of(gpu, sized, camera, circles))
        batch = on_device.take(shots)
        found[f"{name}.time.gpu"], found[f"{name}.light.gpu"] = batch.time_s, np.array(batch.light)
        found[f"{name}.images.gpu"] = batch.images.to_host()
        frames = [source.take(shot) for shot in shots]
        found[f"{name}.time.cpu"] = np.array([frame.exposure.time_s for frame in frames])
        found[f"{name}.light.cpu"] = np.stack([frame.exposure.light for frame in frames])
        mean, noise = zip(*(expected(frame.exposure, sensor) for frame in frames), strict=True)
        found[f"{name}.mean"], found[f"{name}.noise"] = np.stack(mean), np.stack(noise)
        # The noise of a frame is independent of the frames beside it.
        found[f"{name}.alone"] = on_device.take(shots[1:2]).images.to_host()[0]
        for device, tables in (("cpu", map(source.labels, frames)), ("gpu", on_device.labels(batch))):
            joined = pd.concat([label_table(str(k), each).to_pandas() for k, each in enumerate(tables)])
            for column in joined.columns.drop("frame_id"):
                found[f"{name}.labels.{device}.{column}"] = joined[column].to_numpy()
    return found


if __name__ == "__main__":
    main(sys.argv[1])
