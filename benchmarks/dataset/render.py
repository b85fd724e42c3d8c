"""Time per frame of perilune compared with a bare Blender loop over the same scene, poses and passes.

Both write EXR and PNG. The bare loop is a script without perilune: set the camera, render to an EXR with depth and
normals, convert it to a PNG. perilune adds the sensor, labels, visibility, hashes and the manifest. Both run in one
process with frames alternating, so that other load on the machine affects both equally. The second pass for EXRs (depth
and normals at the pixel centres) is timed separately. Writes runs/bench/render.json.
"""

import statistics
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from benchmarks.figures import write_figures
from perilune_render.config.dataset import DatasetConfig
from perilune_render.dataset import tables
from perilune_render.dataset.frame_files import write_frame
from perilune_render.dataset.shots import planned_shot
from perilune_render.engines.blender import bpy
from perilune_render.engines.blender.renderer import Renderer, one_ray_a_pixel, quiet, render_through
from perilune_render.engines.blender.stage import aim
from perilune_render.engines.frame_source import FrameSource
from perilune_render.flight.plan import make_plan
from perilune_render.imaging.exr import read_exr
from perilune_render.labels.frame_labels import RimCircles
from perilune_render.terrain.scene import grow_scene
from perilune_shared.config.resolve import resolve
from perilune_shared.console.terminal import progress_bar

N_FRAMES = 38


def main() -> None:
    """Run the benchmark on the first scene of `small`."""
    config = resolve(DatasetConfig, "dataset", "perilune_render", "small")
    plan = make_plan(config, "detect")
    scene_plan, trajectory = plan.scenes[0], plan.trajectories[0]
    start = time.perf_counter()
    scene = grow_scene(config, plan.view, scene_plan.seed)
    scene_s = time.perf_counter() - start
    ours, bare, centres = [], [], []
    with (
        tempfile.TemporaryDirectory() as folder,
        Renderer(scene, config, plan.exr_camera, scene_plan.sun) as renderer,
        progress_bar() as bar,
    ):
        out = Path(folder)
        source = FrameSource.of(renderer, config, plan.camera, RimCircles.of_scene(scene))
        start = time.perf_counter()
        renderer.render(trajectory.flight.position_m[0], trajectory.flight.rotation_camera_from_site[0])
        first_frame_s = time.perf_counter() - start
        for index in bar.track(range(N_FRAMES), description="frames"):
            pose = trajectory.flight.position_m[index], trajectory.flight.rotation_camera_from_site[index]
            for which in (0, 1) if index % 2 else (1, 0):
                start = time.perf_counter()
                if which == 0:
                    frame_id, frame = trajectory.frame_id(index), source.take(planned_shot(trajectory, index))
                    write_frame(out, frame_id, source, frame, exr=False)
                    tables.label_table(frame_id, source.labels(frame))
                    ours.append(time.perf_counter() - start)
                else:
                    aim(renderer.stage, *pose)
                    path = out / "bare.exr"
                    renderer.stage.render.filepath = str(path)
                    with quiet():
                        bpy.ops.render.render(write_still=True)
                    image = next(v for k, v in read_exr(path).items() if k.endswith("Combined.R"))
                    cv2.imwrite(str(out / "bare.png"), np.clip(image * 1000, 0, 255).astype(np.uint8))
                    bare.append(time.perf_counter() - start)
            start = time.perf_counter()
            with one_ray_a_pixel(renderer.stage):
                render_through(out / "centres.exr", renderer.stage, index)
            centres.append(time.perf_counter() - start)
    figures = {
        "scene_s": scene_s,
        "first_frame_s": first_frame_s,
        "frame_s": statistics.median(ours),
        "bare_frame_s": statistics.median(bare),
        "ratio_to_bare": sum(ours) / sum(bare),
        "centres_pass_s": statistics.median(centres),
        "ratio_with_centres_pass": 1 + sum(centres) / sum(ours),
        "vertices": int(scene.height_m.size),
        "craters": len(scene.craters),
        "boulders": len(scene.boulders),
    }
    write_figures(Path("runs/bench/render.json"), figures)


if __name__ == "__main__":
    main()
