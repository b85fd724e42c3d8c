"""The engine `heightfield` on a CUDA device against the processor: agreement of frames, and frames per second.

`python -m benchmarks.scene.gpu` needs a GPU; `scripts/bench_gpu.sh` runs it on a bare machine. Writes one JSON file
after each step, so that a machine that is taken back leaves what was measured. A difference counts as outside the edges
of shadows if the sunlit pixels of both renderings agree within one pixel of it.
"""

import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer

from benchmarks.figures import write_figures
from benchmarks.scene.truth import POSES, pose
from perilune_render.config.dataset import DatasetConfig
from perilune_render.engines.frame_source import FrameSource, Shot
from perilune_render.engines.heightfield.engine import HeightfieldEngine
from perilune_render.engines.heightfield.gpu import CudaEngine, device_name
from perilune_render.engines.heightfield.gpu_frames import CudaSource
from perilune_render.flight.lens import camera_of
from perilune_render.flight.rig import rig_of
from perilune_render.flight.view import view_of
from perilune_render.labels.frame_labels import RimCircles
from perilune_render.terrain.cache import cached_scene
from perilune_shared.config.resolve import resolve
from perilune_shared.console.command_line import one_command, run_command_line
from perilune_shared.console.terminal import say
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, sun_direction

_PAPER_FRAMES = 34_300
_SUN_DEG = 60, 20


def agreement(cpu: HeightfieldEngine, gpu: CudaEngine, poses: list[tuple[Array, Array]]) -> dict[str, float]:
    """Differences of radiance and depth between both devices, over the frames of all poses."""
    radiance, depth, edges = [], [], 0.0
    for seed, each in enumerate(poses):
        first, second = cpu.render(*each, seed), gpu.render(*each, seed)
        differs = first.sunlit != second.sunlit
        near_edge = cv2.dilate(differs.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
        edges += float(near_edge.mean()) / len(poses)
        error = np.abs(first.radiance_factor - second.radiance_factor) / np.maximum(first.radiance_factor, 1e-3)
        radiance.append(error[~near_edge])
        hit = np.isfinite(first.depth_m) & np.isfinite(second.depth_m)
        depth.append(np.abs(second.depth_m[hit] / first.depth_m[hit] - 1))
    errors = np.concatenate(radiance)
    return {
        "radiance_relative_quantile_0.9999": float(np.quantile(errors, 0.9999)),
        "radiance_share_above_1e-4": float((errors > 1e-4).mean()),
        "depth_relative_max": float(np.concatenate(depth).max()),
        "share_near_differing_shadow_edges": edges,
    }


def frames_per_second(gpu: CudaEngine, poses: list[tuple[Array, Array]], batch: int, seconds: float) -> float:
    """Rendered frames per second in batches, without the copy to the processor."""
    from numba import cuda

    chosen = [poses[k % len(poses)] for k in range(batch)]
    positions, rotations = (np.stack(part) for part in zip(*chosen, strict=True))
    gpu.render_batch(positions, rotations, range(batch))
    cuda.synchronize()
    started, count = time.perf_counter(), 0
    while time.perf_counter() - started < seconds:
        gpu.render_batch(positions, rotations, range(count, count + batch))
        cuda.synchronize()
        count += batch
    return count / (time.perf_counter() - started)


def labelled_per_second(source: CudaSource, poses: list[tuple[Array, Array]], batch: int, seconds: float) -> float:
    """Frames per second with sensor and labels; images stay on the device, labels reach the processor."""
    still = np.zeros(3)
    shots = [Shot(*poses[k % len(poses)], still, 1, k) for k in range(batch)]
    source.labels(source.take(shots))
    started, count = time.perf_counter(), 0
    while time.perf_counter() - started < seconds:
        source.labels(source.take(shots))
        count += batch
    return count / (time.perf_counter() - started)


def resized(camera: Camera, side_px: int) -> Camera:
    """The camera with square frames of another size and the same view."""
    scale = side_px / camera.width_px
    sized = replace(camera, width_px=side_px, height_px=side_px, cx_px=side_px / 2, cy_px=side_px / 2)
    return replace(sized, fx_px=camera.fx_px * scale, fy_px=camera.fy_px * scale)


def main(
    out: Annotated[Path, typer.Option(help="File of figures to write.")] = Path("runs/bench/gpu.json"),
    sides: Annotated[str, typer.Option(help="Widths of the frames, pixels.")] = "64,256,1024",
    batches: Annotated[str, typer.Option(help="Frames per batch.")] = "1,16,256",
    seconds: Annotated[float, typer.Option(help="Time of each measurement.")] = 4.0,
    setting: Annotated[list[str] | None, typer.Option("--set", help="Settings of the preset `small`.")] = None,
) -> None:
    """Compare the frames of a CUDA device with the processor's, and measure its speed."""
    settings = "dataset.render.engine=heightfield", "dataset.render.samples=2", *(setting or [])
    config = resolve(DatasetConfig, "dataset", "perilune_render", "small", None, settings)
    say("generate the ground")
    scene = cached_scene(config, view_of(config, rig_of(config), "detect"), 1)
    poses, sun = [pose(scene, *place) for place in POSES], sun_direction(*_SUN_DEG)
    figures: dict[str, Any] = {"device": device_name(), "speed": {}}
    surface = None
    for side_px in map(int, sides.split(",")):
        camera = resized(camera_of(config.camera), side_px)
        cpu = HeightfieldEngine(scene, config, camera, sun, 1, surface)
        surface = cpu.surface
        gpu = CudaEngine(scene, config, camera, sun, surface)
        source = CudaSource(FrameSource.of(gpu, config, camera, RimCircles.of_scene(scene)))
        figures[f"agreement_{side_px}_px"] = agreement(cpu, gpu, poses)
        for batch in map(int, batches.split(",")):
            rate = frames_per_second(gpu, poses, batch, seconds)
            labelled = labelled_per_second(source, poses, batch, seconds / 2)
            figures["speed"][f"{side_px} px, batches of {batch}"] = {
                "frames_per_s": rate,
                "frames_per_s_with_sensor_and_labels": labelled,
                "million_rays_per_s": rate * side_px**2 * config.render.samples / 1e6,
                "hours_for_a_million_frames": 1e6 / rate / 3600,
                "seconds_for_the_frames_of_the_paper": _PAPER_FRAMES / rate,
            }
            write_figures(out, figures)


if __name__ == "__main__":
    run_command_line(one_command(main))
