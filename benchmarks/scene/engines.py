"""The engines `cycles` and `heightfield` over the same frames: speed, and how far radiance, depth and labels agree.

For agreement both render with many samples, so that the noise of their samples is small. What is left is compared with
the noise of the sensor in the same pixels; pixels within one of a shadow's edge are counted apart. For speed both
render with the samples of a dataset, in the same process. Writes runs/bench/engines.json, and a picture of the
frame with the largest difference into runs/bench/engines.png.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.figures import write_figures
from perilune_render.config.dataset import DatasetConfig
from perilune_render.dataset.shots import planned_shot
from perilune_render.engines.frame_source import Frame, FrameSource, Shot
from perilune_render.engines.open_engine import open_engine
from perilune_render.flight.plan import make_plan
from perilune_render.imaging.radiance import Radiance
from perilune_render.imaging.sensor import Exposure, expected
from perilune_render.labels.frame_labels import Labels, RimCircles
from perilune_render.terrain.cache import cached_scene
from perilune_render.terrain.scene import Scene
from perilune_shared.config.resolve import resolve
from perilune_shared.console.terminal import progress_bar
from perilune_shared.threads import usable_cores

ENGINES = ("cycles", "heightfield")
WIDTHS = (256, 1024)
"""Sizes of the frames whose speed is measured, pixels; the scene is that of the first."""
N_TIMED = 5


def taken(
    engine: str, scene: Scene, config: DatasetConfig, shots: list[Shot], camera, sun
) -> list[tuple[Frame, Labels]]:
    """Frames and labels of an engine."""
    config = config.model_copy(update={"render": config.render.model_copy(update={"engine": engine, "exr": True})})
    found = []
    with open_engine(scene, config, camera, sun) as opened, progress_bar() as progress:
        source = FrameSource.of(opened, config, camera, RimCircles.of_scene(scene))
        task = progress.add_task(engine, total=len(shots), unit="frames", note="")
        for shot in shots:
            frame = source.take(shot)
            found.append((frame, source.labels(frame)))
            progress.advance(task)
    return found


def at_shadow_edge(first: Radiance, second: Radiance) -> np.ndarray:
    """Whether a pixel (h, w) has lit and dark pixels within one pixel of it, in either rendering."""
    near = np.ones((3, 3), np.uint8)
    found = np.zeros(first.sunlit.shape, bool)
    for radiance in (first, second):
        lit = radiance.sunlit.astype(np.uint8)
        found |= cv2.dilate(lit, near) != cv2.erode(lit, near)
    return found


def in_noise(first: Frame, second: Frame, config: DatasetConfig) -> np.ndarray:
    """Differences (h, w) of the light on the sensor, in standard deviations of its grey value in one frame."""
    time_s = first.exposure.time_s
    mean, deviation = expected(first.exposure, config.sensor)
    other, _ = expected(Exposure(second.exposure.light, time_s), config.sensor)
    return np.abs(other - mean) / deviation


def agreement(first: list[tuple[Frame, Labels]], second: list[tuple[Frame, Labels]], config: DatasetConfig) -> dict:
    """Figures of the agreement of two engines over the same frames."""
    noise, edge, depth, normal, ratio, lit = [], [], [], [], [], []
    same_labels = fractions = 0.0
    n_labels = 0
    for (one, labels), (two, others) in zip(first, second, strict=True):
        a, b = one.radiance, two.radiance
        noise.append(in_noise(one, two, config).ravel())
        edge.append(at_shadow_edge(a, b).ravel())
        hit = np.isfinite(a.depth_m) & np.isfinite(b.depth_m)
        depth.append(np.abs(a.depth_m[hit] / b.depth_m[hit] - 1))
        normal.append(np.degrees(np.linalg.norm(a.normal[hit] - b.normal[hit], axis=-1)))
        ratio.append(b.radiance_factor.mean() / a.radiance_factor.mean())
        lit.append((a.sunlit == b.sunlit).mean())
        n_labels += len(labels.crater_id)
        shared = np.isin(labels.crater_id, others.crater_id)
        same_labels += shared.sum()
        place = np.searchsorted(others.crater_id, labels.crater_id[shared])
        fractions = max(
            fractions,
            float(np.abs(labels.visible_fraction[shared] - others.visible_fraction[place]).max()),
        )
    noises, edges, depths, normals = (np.concatenate(part) for part in (noise, edge, depth, normal))
    return {
        "frames": len(first),
        "noise_median": float(np.median(noises[~edges])),
        "noise_q99": float(np.quantile(noises[~edges], 0.99)),
        "noise_median_at_shadow_edges": float(np.median(noises[edges])) if edges.any() else None,
        "noise_q99_at_shadow_edges": float(np.quantile(noises[edges], 0.99)) if edges.any() else None,
        "share_at_shadow_edges": float(edges.mean()),
        "mean_radiance_ratio_least": float(min(ratio)),
        "mean_radiance_ratio_largest": float(max(ratio)),
        "sunlit_share_equal": float(np.mean(lit)),
        "depth_q999_relative": float(np.quantile(depths, 0.999)),
        "depth_share_within_1e-4": float((depths < 1e-4).mean()),
        "normal_q999_deg": float(np.quantile(normals, 0.999)),
        "labels": n_labels,
        "labels_share_shared": same_labels / n_labels,
        "labels_visible_fraction_largest_difference": fractions,
    }


def speed(scene: Scene, config: DatasetConfig, shots: list[Shot], width_px: int, sun) -> dict:
    """Least and median time of a frame with the sensor, seconds, of each engine, and their ratio."""
    plan_camera = config.camera.model_copy(update={"width_px": width_px, "height_px": width_px})
    config = config.model_copy(update={"camera": plan_camera})
    camera = make_plan(config, "detect").exr_camera
    seconds: dict[str, list[float]] = {}
    for engine in ENGINES:
        one = config.model_copy(
            update={"render": config.render.model_copy(update={"engine": engine, "threads": usable_cores()})}
        )
        with open_engine(scene, one, camera, sun) as opened:
            source = FrameSource.of(opened, one, camera, RimCircles.of_scene(scene))
            source.take(shots[0])
            times = seconds.setdefault(engine, [])
            for shot in shots * N_TIMED:
                start = time.perf_counter()
                source.take(shot)
                times.append(time.perf_counter() - start)
    found = {f"{engine}_{width_px}_s": float(np.median(times)) for engine, times in seconds.items()}
    found |= {f"{engine}_{width_px}_least_s": float(min(times)) for engine, times in seconds.items()}
    medians = [float(np.median(seconds[engine])) for engine in ENGINES]
    return found | {f"speed_ratio_{width_px}": medians[0] / medians[1]}


def picture(first: Frame, second: Frame, noise: np.ndarray) -> np.ndarray:
    """Both frames and their difference, black for none, white for two standard deviations of the sensor."""
    shown = [frame.image.astype(np.uint8) for frame in (first, second)]
    return np.hstack([*shown, np.clip(noise * 127, 0, 255).astype(np.uint8)])


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--preset", default="small")
    parser.add_argument("--scenes", type=int, default=2)
    parser.add_argument("--samples", type=int, default=256)
    given = parser.parse_args()
    config = resolve(DatasetConfig, "dataset", "perilune_render", given.preset)
    plan = make_plan(config, "detect")
    many = config.model_copy(update={"render": config.render.model_copy(update={"samples": given.samples})})
    figures: dict[str, object] = {}
    taken_by: dict[str, list[tuple[Frame, Labels]]] = {engine: [] for engine in ENGINES}
    for one in plan.scenes[: given.scenes]:
        trajectory = plan.of_scene(one.scene_id)[0]
        chosen = np.linspace(0, len(trajectory.splits) - 1, 3).round().astype(int)
        shots = [replace(planned_shot(trajectory, int(k)), velocity_mps=np.zeros(3)) for k in chosen]
        scene = cached_scene(config, plan.view, one.seed)
        for engine in ENGINES:
            taken_by[engine] += taken(engine, scene, many, shots, plan.exr_camera, one.sun)
        if not figures:
            for width in WIDTHS:
                figures |= speed(scene, config, shots, width, one.sun)
    first, second = (taken_by[engine] for engine in ENGINES)
    figures |= {"preset": given.preset, "scenes": given.scenes, "samples": given.samples}
    figures |= agreement(first, second, many)
    noises = [in_noise(a[0], b[0], many) for a, b in zip(first, second, strict=True)]
    worst = int(np.argmax([noise.mean() for noise in noises]))
    write_figures(Path("runs/bench/engines.json"), figures)
    cv2.imwrite("runs/bench/engines.png", picture(first[worst][0], second[worst][0], noises[worst]))


if __name__ == "__main__":
    main()
