"""Error of label ellipses: their distance from glowing rings rendered on the same rim circles.

Generates scenes of `small` for their rim circles, tilts included. At altitudes of 200 to 1500 m and views of up to 45
degrees from nadir, `label_frame` makes the labels. Blender renders rings on the labelled circles with the project's
camera at 8 x 8 times its number of pixels. Ring and ellipse are compared along 64 normals of each label. The same
is repeated with lens distortion, and at the frame's own resolution, where only large craters can be measured. Writes
runs/bench/labels.json and, with `--picture FILE`, a histogram.
"""

import argparse
import tempfile
import time
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.figures import write_figures
from benchmarks.scene import rings
from perilune_render.config.dataset import DatasetConfig
from perilune_render.flight.plan import make_plan
from perilune_render.imaging.resampling import refined, resample
from perilune_render.labels.frame_labels import RimCircles
from perilune_render.terrain.interpolation import value_at
from perilune_render.terrain.scene import Scene, grow_scene
from perilune_shared.config.resolve import resolve
from perilune_shared.console.terminal import progress_bar
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY, Camera
from perilune_shared.geometry.frames import Array, matrix_from_rotation_vector
from perilune_shared.storage.files import written_aside

ALTITUDES_M = (200.0, 400.0, 800.0, 1500.0)
TILTS_DEG = (0.0, 15.0, 30.0, 45.0)
RADII_PX = (2.0, 5.0, 10.0, 20.0, 50.0)
SCALE = 8
DISTORTION = (-0.06, 0.0, 0.001, 0.0, 0.0)
"""About 5 px of distortion in the corners."""


@dataclass(frozen=True, slots=True)
class Measured:
    """Measurements of one pose."""

    altitude_m: float
    """Altitude above the ground point on the camera's axis, metres."""
    tilt_deg: float
    """Angle of the camera's axis from nadir, degrees."""
    radius_px: Array
    """sqrt(a b) of the labels, pixels (N,)."""
    offset_px: Array
    """Distances of the rings from the labels, along the labels' outward normals, pixels (N, 64)."""
    scale: int
    """Pixels of the picture for one pixel of the frame, along each axis."""
    n_labels: int
    """Number of labels of the frame, measured or not."""
    n_too_narrow: int
    """Number of labels that are too narrow to be measured, including those only partly in the frame."""

    @property
    def error_px(self) -> Array:
        """R.m.s. distance over the directions, pixels (N,)."""
        return rings.errors_px(self.offset_px, self.scale)

    @property
    def ellipse_error_px(self) -> Array:
        """R.m.s. of the distances' harmonics up to the second: shift, size, flattening and rotation, pixels (N,)."""
        part = np.fft.rfft(np.nan_to_num(self.offset_px, nan=rings.REACH_PX / self.scale), axis=1)[:, :3]
        weight = np.array([1.0, 2.0, 2.0]) / self.offset_px.shape[1] ** 2
        return np.sqrt(np.abs(part) ** 2 @ weight)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description="compare label ellipses with rendered rings")
    parser.add_argument("--picture", type=Path, default=Path("runs/bench/labels.png"), help="the histogram to write")
    picture = parser.parse_args().picture
    start = time.perf_counter()
    config = resolve(DatasetConfig, "dataset", "perilune_render", "small")
    plan = make_plan(config, "detect")
    distorted = replace(plan.camera, distortion=DISTORTION)
    rng = np.random.default_rng(1)
    main_run, native, through_lens = [], [], []
    with tempfile.TemporaryDirectory() as folder, progress_bar() as bar:
        task = bar.add_task("poses", total=len(ALTITUDES_M) * len(TILTS_DEG), unit="poses", note="")
        for scene_plan, altitude_m in zip(plan.scenes, ALTITUDES_M, strict=False):
            scene = grow_scene(config, plan.view, scene_plan.seed)
            for tilt_deg in TILTS_DEG:
                pose = altitude_m, tilt_deg, *view(scene, altitude_m, tilt_deg, rng)
                main_run.append(measure(Path(folder), scene, plan.camera, SCALE, 16, *pose))
                native.append(measure(Path(folder), scene, plan.camera, 1, 256, *pose))
                if tilt_deg in (0.0, 30.0):
                    through_lens.append(measure(Path(folder), scene, distorted, SCALE, 16, *pose))
                bar.advance(task)
    corner = distorted.project(plan.camera.rays([0.0, 0.0]))
    figures = {
        **summary(main_run),
        "by_tilt_deg": {f"{t:g}": summary([j for j in main_run if j.tilt_deg == t]) for t in TILTS_DEG},
        "by_altitude_m": {f"{a:g}": summary([j for j in main_run if j.altitude_m == a]) for a in ALTITUDES_M},
        "by_radius_px": by_radius(main_run),
        "labels": sum(j.n_labels for j in main_run),
        "labels_too_narrow": sum(j.n_too_narrow for j in main_run),
        **{f"distorted_{name}": value for name, value in summary(through_lens).items()},
        "distorted_corner_px": float(np.linalg.norm(corner)),
        "distorted_by_radius_px": by_radius(through_lens),
        **{f"native_{name}": value for name, value in summary(native).items()},
        "time_s": time.perf_counter() - start,
    }
    write_figures(Path("runs/bench/labels.json"), figures)
    draw_histogram(picture, main_run)


def view(scene: Scene, altitude_m: float, tilt_deg: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Position (3,) and rotation_camera_from_site (3, 3) of a camera, with random roll, that looks at ground nearby."""
    turn, aside = rng.uniform(0, 2 * np.pi, 2)
    lean = np.radians(tilt_deg) * np.array([np.cos(aside), np.sin(aside), 0.0])
    turned = matrix_from_rotation_vector(np.array([0.0, 0.0, turn]))
    rotation = ROTATION_CAMERA_FROM_BODY @ matrix_from_rotation_vector(lean) @ turned
    x, y = rng.uniform(-30, 30, 2)
    target = np.array([x, y, float(value_at(scene.height_m, scene.grid, x, y))])
    return target - altitude_m * rotation[2] / abs(rotation[2, 2]), rotation


def measure(
    folder: Path,
    scene: Scene,
    camera: Camera,
    scale: int,
    samples: int,
    altitude_m: float,
    tilt_deg: float,
    position_m: Array,
    rotation: Array,
) -> Measured:
    """Label, render and compare one pose; lens distortion is applied to the picture as to frames."""
    circles = RimCircles.of_scene(scene)
    labels = rings.labels_of(circles, camera, position_m, rotation)
    rows = rings.apart(labels.ellipses, camera, scale)
    source = refined(camera.covering_pinhole(), scale)
    image = rings.render_rings(folder, circles, labels.crater_id[rows], source, position_m, rotation, samples)
    ellipses = rings.rows_of(labels.ellipses, rows)
    offsets = rings.ring_offsets(resample(image, refined(camera, scale), source), scale, ellipses)
    n_too_narrow = int((~rings.wide_enough(labels.ellipses, scale)).sum())
    return Measured(altitude_m, tilt_deg, ellipses.radius_px(), offsets, scale, len(labels.crater_id), n_too_narrow)


def summary(measured: list[Measured], low_px: float = 0.0, high_px: float = np.inf) -> dict[str, float]:
    """Figures over the craters of several poses whose radius lies within bounds."""
    radius = np.concatenate([j.radius_px for j in measured])
    chosen = (radius >= low_px) & (radius < high_px)
    error = np.concatenate([j.error_px for j in measured])[chosen]
    offset = np.concatenate([j.offset_px for j in measured])[chosen]
    ellipse = np.concatenate([j.ellipse_error_px for j in measured])[chosen]
    return {
        "mean_px": float(error.mean()),
        "max_px": float(error.max()),
        "n": len(error),
        "median_px": float(np.median(error)),
        "q99_px": float(np.quantile(error, 0.99)),
        "ellipse_mean_px": float(ellipse.mean()),
        "ellipse_max_px": float(ellipse.max()),
        "mean_offset_px": float(np.nanmean(offset)),
        "max_offset_px": float(np.nanmax(np.abs(offset))),
        "directions_without_ring": int(np.isnan(offset).sum()),
    }


def by_radius(measured: list[Measured]) -> dict[str, dict[str, float]]:
    """Figures for each range of radii."""
    return {f"{low:g}-{high:g}": summary(measured, low, high) for low, high in pairwise(RADII_PX)}


def draw_histogram(path: Path, measured: list[Measured]) -> None:
    """Draw errors of all craters, stacked by the view's tilt: total, and the part up to the second harmonic."""
    figure, panels = plt.subplots(1, 2, figsize=(8.4, 2.6), layout="constrained")
    colours = plt.get_cmap("viridis")(np.linspace(0.1, 0.9, len(TILTS_DEG)))
    bins = np.linspace(0, 0.011, 45)
    wholes = [[j.error_px for j in measured if j.tilt_deg == tilt] for tilt in TILTS_DEG]
    ellipses = [[j.ellipse_error_px for j in measured if j.tilt_deg == tilt] for tilt in TILTS_DEG]
    titles = ("all 64 directions", "shift, size, flattening and rotation only")
    for axes, parts, title in zip(panels, (wholes, ellipses), titles, strict=True):
        values = [np.minimum(np.concatenate(part), bins[-1]) for part in parts]
        axes.hist(values, bins=list(bins), stacked=True, color=list(colours), label=[f"{t:g}°" for t in TILTS_DEG])
        axes.set(xlabel="r.m.s. distance of label and ring, px", xlim=(0, bins[-1]))
        axes.set_title(title, fontsize=10)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("craters")
    panels[1].legend(frameon=False, fontsize=8, title="tilt from nadir", title_fontsize=8)
    with written_aside(path) as aside:
        figure.savefig(aside, dpi=100)
    plt.close(figure)


if __name__ == "__main__":
    main()
