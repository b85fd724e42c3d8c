"""Descents of a preset in frames of 1024 x 1024 pixels at half-pixel spacing: memory, time, changes of level.

Of each level of the first trajectory it renders the first two frames and the last one, with perilune and with a bare
Blender loop over the same mesh (as in `benchmarks.dataset.render`), alternately. It measures the peak of the resident
memory, terrain generation included, and the KLT residuals of consecutive frames within levels and across changes of
level. Writes runs/bench/megapixel.json, and the frames on both sides of each change into runs/bench/megapixel/.
"""

import argparse
import resource
import statistics
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from benchmarks.figures import write_figures
from benchmarks.scene.tracking import klt_residuals_px
from perilune_render.config.dataset import DatasetConfig
from perilune_render.dataset import tables
from perilune_render.dataset.frame_files import write_frame
from perilune_render.dataset.shots import planned_shot
from perilune_render.engines.blender import bpy
from perilune_render.engines.blender.renderer import Renderer, quiet
from perilune_render.engines.blender.stage import aim
from perilune_render.engines.frame_source import Frame, FrameSource
from perilune_render.flight.plan import TrajectoryPlan, make_plan
from perilune_render.imaging.exr import read_exr
from perilune_render.labels.frame_labels import RimCircles
from perilune_render.terrain.cache import cached_scene
from perilune_render.terrain.levels import cut_levels, level_index
from perilune_shared.config.resolve import resolve
from perilune_shared.console.terminal import progress_bar

SETTINGS = (
    "dataset.camera.width_px=1024",
    "dataset.camera.height_px=1024",
    "dataset.detect.n_frames=100",
)
PICTURES = Path("runs/bench/megapixel")


def take(source: FrameSource, trajectory: TrajectoryPlan, index: int, out: Path) -> tuple[Frame, float]:
    """A frame as a dataset has it: rendered, developed, written and labelled; and the time that it took, seconds."""
    start = time.perf_counter()
    frame_id, frame = trajectory.frame_id(index), source.take(planned_shot(trajectory, index))
    write_frame(out, frame_id, source, frame, exr=False)
    tables.label_table(frame_id, source.labels(frame))
    return frame, time.perf_counter() - start


def bare(renderer: Renderer, frame: Frame, out: Path) -> float:
    """Time, seconds, in which Blender alone renders a frame to an EXR, which is converted to a PNG."""
    start = time.perf_counter()
    aim(renderer.stage, *frame.shot.pose)
    path = out / "bare.exr"
    renderer.stage.render.filepath = str(path)
    with quiet():
        bpy.ops.render.render(write_still=True)
    image = next(pixels for name, pixels in read_exr(path).items() if name.endswith("Combined.R"))
    cv2.imwrite(str(out / "bare.png"), np.clip(image * 1000, 0, 255).astype(np.uint8))
    return time.perf_counter() - start


def main() -> None:
    """Run the benchmark on the first scene and trajectory of a preset with a larger camera."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--preset", default="small")
    parser.add_argument("--levels", type=int, nargs="*", help="levels to render, 0 is the finest; all if not given")
    parser.add_argument("--set", action="append", default=[], help="a setting, for a part of the descent")
    parser.add_argument("--skip-bare", action="store_true", help="leave out the bare Blender loop")
    options = parser.parse_args()
    levels = options.levels
    config = resolve(DatasetConfig, "dataset", "perilune_render", options.preset, settings=(*SETTINGS, *options.set))
    plan = make_plan(config, "detect")
    scene_plan, trajectory = plan.scenes[0], plan.trajectories[0]
    start = time.perf_counter()
    scene = cached_scene(config, plan.view, scene_plan.seed)
    scene_s = time.perf_counter() - start
    scene_gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    cut = cut_levels(config.terrain, plan.view, trajectory.flight.nominal.approach_deg)
    level = np.array([level_index(cut, z) for z in trajectory.flight.position_m[:, 2]])
    chosen = [k for k in sorted(set(level.tolist()), reverse=True) if levels is None or k in levels]
    changes, ours, bares = [], [], []
    within: list[np.ndarray] = []
    across: list[np.ndarray] = []
    last: tuple[int, Frame] | None = None
    with (
        tempfile.TemporaryDirectory() as folder,
        Renderer(scene, config, plan.exr_camera, scene_plan.sun) as renderer,
        progress_bar() as bar,
    ):
        out = Path(folder)
        source = FrameSource.of(renderer, config, plan.camera, RimCircles.of_scene(scene))
        for k in bar.track(chosen, description="levels"):
            places = np.flatnonzero(level == k)
            for index in sorted({int(places[0]), int(places[min(1, len(places) - 1)]), int(places[-1])}):
                if index == places[0]:
                    # The first rendering on a level includes the building of its mesh: time it apart.
                    begin = time.perf_counter()
                    source.render(planned_shot(trajectory, index))
                    changes.append(time.perf_counter() - begin)
                frame, frame_s = take(source, trajectory, index, out)
                ours.append(frame_s)
                if not options.skip_bare:
                    bares.append(bare(renderer, frame, out))
                if last is not None and last[0] == index - 1:
                    poses = last[1].shot.pose, frame.shot.pose
                    residuals = klt_residuals_px(plan.exr_camera, last[1].radiance, frame.radiance, *poses)
                    (across if index == places[0] else within).append(residuals)
                last = index, frame
                PICTURES.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(PICTURES / f"{index:03d}-level-{k:02d}.png"), frame.image)
    figures = {
        "ground_vertices": scene.grid.n_vertices,
        "levels": len(cut),
        "levels_rendered": len(chosen),
        "frames_rendered": len(ours),
        "most_vertices": max(own.grid.n_vertices for own in cut),
        "vertices_of_all_levels": sum(own.grid.n_vertices for own in cut),
        "craters": len(scene.craters),
        "boulders": len(scene.boulders),
        "scene_s": scene_s,
        "scene_peak_gib": scene_gib,
        "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "change_of_level_s": statistics.median(changes),
        "frame_s": statistics.median(ours),
        "bare_frame_s": statistics.median(bares) if bares else None,
        "ratio_to_bare": sum(ours) / sum(bares) if bares else None,
        "klt_within_median_px": float(np.median(np.concatenate(within))) if within else None,
        "klt_across_median_px": float(np.median(np.concatenate(across))) if across else None,
        "klt_within_90_px": float(np.percentile(np.concatenate(within), 90)) if within else None,
        "klt_across_90_px": float(np.percentile(np.concatenate(across), 90)) if across else None,
    }
    write_figures(Path("runs/bench/megapixel.json"), figures)


if __name__ == "__main__":
    main()
