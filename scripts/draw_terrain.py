"""Draw the pictures of docs/explanation/terrain.md: profiles, altitudes, Sun elevations, regions, an elevation model.

    python scripts/draw_terrain.py docs/pictures/terrain [--dem file.tif]

writes them into the folder docs/pictures/terrain.
"""

import argparse
from pathlib import Path

from perilune_shared.console.interrupts import end_at_interrupt

if __name__ == "__main__":
    # An import by another module must not change how Ctrl-C works.
    end_at_interrupt()

import cv2
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from perilune_render.config.dataset import DatasetConfig
from perilune_render.engines.blender.renderer import Renderer
from perilune_render.flight.lens import camera_of
from perilune_render.flight.view import view_envelope
from perilune_render.imaging.sensor import FixedPattern, expose, read_out
from perilune_render.terrain.cache import cached_scene
from perilune_render.terrain.craters import profile
from perilune_render.terrain.scene import Scene
from perilune_shared.config.resolve import resolve
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY
from perilune_shared.geometry.frames import sun_direction
from perilune_shared.storage.files import written_aside

SEED = 23


def draw_profiles(path: Path) -> None:
    """Draw sections through craters: fresh craters by size and profile law (top row), two sizes by age (bottom row)."""
    figure, axes = plt.subplots(2, 2, figsize=(10, 6), sharex=True)
    x = np.linspace(-2, 2, 1201)
    for ax, name in zip(axes[0], ("fassett_thomson", "pangu"), strict=True):
        for d in (5.0, 30.0, 120.0, 600.0):
            depth = profile.fresh_depth_m(d)
            rim = profile.fresh_rim_height_m(d, depth, name)
            height = rim * profile.fresh_rim(np.abs(x), name) + depth * profile.fresh_bowl(np.abs(x), name)
            ax.plot(x, height / d, label=f"{d:g} m")
        flat = rim * profile.fresh_rim(np.abs(x), name) + depth * profile.fresh_bowl(np.abs(x), name, flat=True)
        ax.plot(x, flat / d, ":", color="tab:red", label="600 m, flat floor")
        ax.set(title=f"fresh, {name}", ylabel="height / diameter")
        ax.legend(fontsize=8)
    for ax, d in zip(axes[1], (20.0, 300.0), strict=True):
        tables = profile.profile_tables()
        depth = profile.fresh_depth_m(d)
        rim = profile.fresh_rim_height_m(d, depth)
        for wear in (0.0002, 0.003, 0.01, 0.03, 0.1):
            row = round(float(profile.wear_row(np.array([wear]))[0]))
            crest = float(profile.crest_radius(np.array([wear]), np.array([depth / rim]))[0])
            shape = rim * tables.rim[row] + depth * tables.bowl[row]
            at = np.abs(x) * crest * (len(shape) - 1) / profile.REACH
            age = wear * (d / 2) ** 2 / (5.5 * (d / 1000) ** 0.9)
            ax.plot(x, np.interp(at, np.arange(len(shape)), shape) / d, label=f"{age:.3g} Myr, K/R² {wear:g}")
        ax.set(title=f"{d:g} m, by age", xlabel="distance / current crest radius", ylabel="height / diameter")
        ax.legend(fontsize=8)
    with written_aside(path) as aside:
        figure.savefig(aside, dpi=90, bbox_inches="tight")
    plt.close(figure)


def settings(*changes: str, config_file: Path | None = None) -> DatasetConfig:
    """The preset `small` with frames of 384 px and the given changes."""
    size = ("dataset.camera.width_px=384", "dataset.camera.height_px=384", "dataset.render.samples=8")
    wide = ("dataset.terrain.max_vertices=30000000", "dataset.detect.flight.downrange_m=0.0")
    return resolve(DatasetConfig, "dataset", "perilune_render", "small", config_file, (*size, *wide, *changes))


def nadir_frames(
    config: DatasetConfig, scene: Scene, views: list[tuple[float, float]], centre_m: tuple[float, float] = (0.0, 0.0)
) -> list[np.ndarray]:
    """Grey frames looking straight down; `views` are altitudes (metres) with Sun elevations (degrees)."""
    camera = camera_of(config.camera)
    pattern = FixedPattern.draw(config.sensor, camera, SEED)
    frames = []
    for altitude, elevation in views:
        with Renderer(scene, config, camera, sun_direction(70, elevation)) as renderer:
            radiance = renderer.render(np.array([*centre_m, altitude]), ROTATION_CAMERA_FROM_BODY)
        rng = np.random.default_rng(SEED)
        exposure = expose(radiance, config.sensor, camera, camera, np.zeros(3))
        frames.append(read_out(exposure, config.sensor, pattern, rng))
    return frames


def write_row(path: Path, frames: list[np.ndarray], captions: list[str]) -> None:
    """Write frames side by side, each with a line of text, as JPEG."""
    pictures = []
    for frame, caption in zip(frames, captions, strict=True):
        picture = cv2.copyMakeBorder(frame, 0, 22, 2, 2, cv2.BORDER_CONSTANT, value=255)
        cv2.putText(picture, caption, (6, picture.shape[0] - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.45, 0, 1, cv2.LINE_AA)
        pictures.append(picture)
    with written_aside(path) as aside:
        aside.write_bytes(cv2.imencode(".jpg", np.hstack(pictures), [cv2.IMWRITE_JPEG_QUALITY, 88])[1].tobytes())


def main() -> None:
    """Write every picture into the given folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--dem", type=Path)
    arguments = parser.parse_args()
    out = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    draw_profiles(out / "profiles.png")
    config = settings()
    flight = config.detect.flight
    scene = cached_scene(config, view_envelope(camera_of(config.camera), flight), SEED)
    altitudes = (1500.0, 800.0, 400.0, 200.0)
    frames = nadir_frames(config, scene, [(a, 28.0) for a in altitudes])
    write_row(out / "altitudes.jpg", frames, [f"{a:.0f} m, Sun 28 deg" for a in altitudes])
    suns = (8.0, 20.0, 40.0, 65.0)
    frames = nadir_frames(config, scene, [(600.0, s) for s in suns])
    write_row(out / "suns.jpg", frames, [f"600 m, Sun {s:.0f} deg" for s in suns])
    frames, captions = [], []
    for region in ("mare", "highland"):
        region_config = settings(config_file=Path("configs") / f"{region}.yaml")
        grown = cached_scene(region_config, view_envelope(camera_of(region_config.camera), flight), SEED)
        frames += nadir_frames(region_config, grown, [(1200.0, 25.0), (300.0, 25.0)])
        captions += [f"{region}, 1200 m", f"{region}, 300 m"]
    write_row(out / "regions.jpg", frames, captions)
    if arguments.dem is not None:
        frames, captions = [], []
        bare = (
            "dataset.terrain.boulders.density=0.0",
            "dataset.terrain.craters.max_diameter_m=0.1",
            "dataset.terrain.relief.rms_slope_deg={low: 0.0, high: 0.0}",
        )
        for name, changes in (("the model alone", bare), ("with generated detail", ())):
            dem_config = settings(f"dataset.terrain.dem={arguments.dem}", *changes)
            grown = cached_scene(dem_config, view_envelope(camera_of(dem_config.camera), flight), SEED)
            frames += nadir_frames(dem_config, grown, [(1000.0, 15.0), (250.0, 15.0)], (-150.0, 200.0))
            captions += [f"{name}, 1000 m", f"{name}, 250 m"]
        write_row(out / "elevation.jpg", frames, captions)


if __name__ == "__main__":
    main()
