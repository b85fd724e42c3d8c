"""Compare rendered frames with Narrow Angle Camera crops at the same ground sampling and under the same Sun.

`make compare-nac NAC=folder`: the folder holds 8-bit PNG crops named by their product number, from which the position
of the Sun is computed, and a text file of human-drawn crater boxes beside each. For every crop, renders a nadir view of
several scenes of the configuration. Writes to runs/nac/: nac.json, curves that may be published (spectra, gradients,
brightness, counts) and sheet.png, which contains real pixels and must not be published.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer

from benchmarks.figures import write_figures
from benchmarks.nac import statistics as st
from benchmarks.nac.plots import draw_curves
from benchmarks.nac.sun import sun_over, time_of
from perilune_render.config.dataset import CameraConfig, DatasetConfig, FlightConfig
from perilune_render.engines.blender.renderer import Renderer
from perilune_render.flight.view import view_envelope
from perilune_render.imaging.radiance import Radiance
from perilune_render.imaging.sensor import FixedPattern, expose, read_out
from perilune_render.labels.drawing import write_sheet
from perilune_render.labels.frame_labels import RimCircles, label_frame
from perilune_render.streams import derived_seed, stream
from perilune_render.terrain.scene import Scene, grow_scene
from perilune_shared.config.resolve import resolve
from perilune_shared.console.command_line import one_command, run_command_line
from perilune_shared.console.terminal import progress_bar
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY, Camera
from perilune_shared.geometry.frames import Array, sun_direction

FRAME_PX, FOV_DEG = 400, 12.0
THRESHOLDS_PX = (8.0, 12.0, 16.0, 24.0, 32.0, 48.0, 64.0)
DEPTH_RATIOS = (0.02, 0.03, 0.04, 0.05, 0.06)
CLEAR = 0.04
"""Smallest depth over diameter of rendered craters that a person is assumed to mark."""
LEAST_PX = 8.0
"""Smallest diameter of marked craters, pixels."""
HIGHEST_ABOVE = 1.6
"""Start altitude over the frame's altitude: extends the ground beyond the frame, as far as the vertex limit allows."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A grey image with its craters: a real crop or a rendered frame."""

    name: str
    """Product name or scene."""
    image: np.ndarray
    """Grey values (h, w), north up."""
    azimuth_deg: float
    """Azimuth of the Sun, clockwise from north."""
    elevation_deg: float
    """Elevation of the Sun."""
    circles: Array
    """Centre x, y and diameter in pixels of the craters that are centred in the image (N, 3)."""
    depth_ratio: Array
    """Their depth over diameter (N,); NaN for real ones."""


def read_crops(folder: Path, latitude_deg: float, longitude_deg: float) -> list[Picture]:
    """The folder's crops, sorted by the Sun's elevation at the site."""
    if not folder.is_dir():
        raise UserError(folder, "NAC", "no such folder", "a folder of NAC crops (make compare-nac NAC=folder)")
    crops = []
    for path in sorted(folder.glob("*.png")):
        time = time_of(path.name)
        if time is None:
            raise UserError(path, "name", path.name, "a name that begins with a product number, M and 9 or 10 digits")
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None or not image.any() or min(image.shape) < FRAME_PX:
            raise UserError(
                path, "image", "an unreadable, black or small file", f"a PNG of at least {FRAME_PX} x {FRAME_PX} pixels"
            )
        boxes_path = path.with_suffix(".txt")
        if not boxes_path.is_file():
            raise UserError(boxes_path, "boxes", "no such file", "a text file of crater boxes beside each PNG")
        circles = st.box_circles(st.read_boxes(boxes_path), image.shape[1], image.shape[0])
        azimuth, elevation = sun_over(latitude_deg, longitude_deg, time)
        if elevation <= 0:
            raise UserError(
                path,
                "Sun",
                f"{elevation:.1f} degrees",
                "a crop of the site in dataset.terrain, with the Sun above the horizon",
            )
        crops.append(
            Picture(path.name.split("_")[0], image, azimuth, elevation, circles, np.full(len(circles), np.nan))
        )
    if not crops:
        raise UserError(folder, "NAC", "no PNG", "a folder of NAC crops (make compare-nac NAC=folder)")
    return sorted(crops, key=lambda crop: crop.elevation_deg)


def nadir_view(config: DatasetConfig, sampling_m: float) -> tuple[DatasetConfig, Camera, FlightConfig]:
    """Configuration, camera and flight of a narrow nadir view whose pixels are `sampling_m` wide on the ground."""
    settings = CameraConfig(width_px=FRAME_PX, height_px=FRAME_PX, horizontal_fov_deg=FOV_DEG)
    camera = Camera.from_field_of_view(FRAME_PX, FRAME_PX, FOV_DEG)
    altitude = sampling_m * camera.fx_px
    flight = FlightConfig(
        start_altitude_m=HIGHEST_ABOVE * altitude,
        end_altitude_m=altitude,
        downrange_m=0.0,
        position_sigma_m=0.0,
        attitude_sigma_deg=0.0,
    )
    return config.model_copy(update={"camera": settings}), camera, flight


def take_frame(
    scene: Scene, config: DatasetConfig, camera: Camera, altitude_m: float, azimuth_deg: float, elevation_deg: float
) -> Picture:
    """Render one frame of a scene from vertically above the site."""
    pose = np.array([0.0, 0.0, altitude_m]), ROTATION_CAMERA_FROM_BODY
    with Renderer(scene, config, camera, sun_direction(azimuth_deg, elevation_deg)) as renderer:
        radiance = renderer.render(*pose)
    labels = label_frame(RimCircles.of_scene(scene), camera, *pose, radiance, (LEAST_PX / 2, 1e4))
    e, ratio = labels.ellipses, scene.rims.depth_m / scene.craters.diameter_m
    # X_L points west and Y_L south: a rotation by 180 degrees puts north up.
    return Picture(
        f"scene {scene.seed % 10000:04d}",
        np.rot90(_developed(radiance, config, camera, scene.seed), 2),
        azimuth_deg,
        elevation_deg,
        np.stack([FRAME_PX - e.cx_px, FRAME_PX - e.cy_px, 2 * e.radius_px()], axis=1),
        ratio[labels.crater_id],
    )


def _developed(radiance: Radiance, config: DatasetConfig, camera: Camera, seed: int) -> np.ndarray:
    """Grey values, for a camera at rest."""
    pattern = FixedPattern.draw(config.sensor, camera, seed)
    exposure = expose(radiance, config.sensor, camera, camera, np.zeros(3))
    return read_out(exposure, config.sensor, pattern, stream(seed, "nac"))


def take_frames(config: DatasetConfig, crops: list[Picture], n_scenes: int, sampling_m: float) -> list[list[Picture]]:
    """For each crop, one frame of each scene under the crop's Sun."""
    config, camera, flight = nadir_view(config, sampling_m)
    frames: list[list[Picture]] = [[] for _ in crops]
    with progress_bar() as bar:
        task = bar.add_task("frames", total=n_scenes * len(crops), unit="frames")
        for number in range(n_scenes):
            scene = grow_scene(config, view_envelope(camera, flight), derived_seed(config.seed, "nac", number))
            for crop, taken in zip(crops, frames, strict=True):
                taken.append(
                    take_frame(scene, config, camera, flight.end_altitude_m, crop.azimuth_deg, crop.elevation_deg)
                )
                bar.advance(task)
    return frames


def figures_of(pictures: list[Picture], least_depth_ratio: float | None = None) -> dict:
    """Statistics over several pictures: medians of the figures and of the spectrum, and the count of all craters."""
    single = [st.summary(picture.image) for picture in pictures]
    area = sum(picture.image.size for picture in pictures)
    diameter = np.concatenate([_circles(picture, least_depth_ratio)[:, 2] for picture in pictures])
    return {
        **{name: float(np.median([figures[name] for figures in single])) for name in single[0]},
        "spectrum": np.median([st.power_spectrum(picture.image) for picture in pictures], axis=0).tolist(),
        "craters": st.cumulative_counts(diameter, area, THRESHOLDS_PX).tolist(),
    }


def _circles(picture: Picture, least_depth_ratio: float | None) -> Array:
    if least_depth_ratio is None:
        return picture.circles
    return picture.circles[picture.depth_ratio >= least_depth_ratio]


def contrasts(pictures: list[Picture], least_depth_ratio: float | None = None) -> dict[str, float | None]:
    """Median contrast of the craters between two diameters; null if there are fewer than five."""
    chosen = [_circles(picture, least_depth_ratio) for picture in pictures]
    contrast = np.concatenate([st.crater_contrast(p.image, c) for p, c in zip(pictures, chosen, strict=True)])
    diameter = np.concatenate(chosen)[:, 2]
    found: dict[str, float | None] = {}
    for low, high in ((8, 12), (12, 24), (24, 48)):
        values = contrast[(diameter >= low) & (diameter < high) & np.isfinite(contrast)]
        found[f"{low}_{high}_px"] = float(np.median(values)) if len(values) >= 5 else None
    return found


def distances(ours: dict, real: dict) -> dict[str, float]:
    """Differences between rendered and real statistics; 0 means equal. Logarithms are to base 10."""
    spectra = np.array(ours["spectrum"]), np.array(real["spectrum"])
    apart = st.log_difference(*spectra, 0.02, 0.4)
    # A crop's contrast may have been stretched: stretching does not change the shape of its spectrum.
    found = {"spectrum_rms_0.02_0.4": float(np.sqrt(np.mean(apart**2))), "spectrum_shape_rms": float(apart.std())}
    for low, high in ((0.01, 0.03), (0.03, 0.1), (0.1, 0.25), (0.25, 0.5)):
        found[f"spectrum_log_{low}_{high}"] = float(np.mean(st.log_difference(*spectra, low, high)))
    for name in ("std", "gradient_median", "gradient_p99", "gradient_tail"):
        found[f"{name}_log"] = float(np.log10(ours[name] / real[name]))
    for name in ("skewness", "p1", "p99", "shadow_share"):
        found[f"{name}_difference"] = ours[name] - real[name]
    return found


def count_distances(ours: list[float], real: list[float]) -> dict[str, float | None]:
    """log10 of the rendered over the real count from 8, 16 and 32 pixels; null if either is 0."""
    found: dict[str, float | None] = {}
    for threshold, a, b in zip(THRESHOLDS_PX, ours, real, strict=True):
        if threshold in (8, 16, 32):
            found[f"{threshold:.0f}_px"] = float(np.log10(a / b)) if a > 0 and b > 0 else None
    return found


def compare(crops: list[Picture], frames: list[list[Picture]]) -> dict:
    """All figures: each crop and the frames under its Sun, medians of their differences, counts of all craters."""
    rows: list[dict[str, Any]] = []
    for crop, taken in zip(crops, frames, strict=True):
        ours, real = figures_of(taken), figures_of([crop])
        sun = {"azimuth_deg": crop.azimuth_deg, "elevation_deg": crop.elevation_deg}
        ours["crater_contrast"], real["crater_contrast"] = contrasts(taken, CLEAR), contrasts([crop])
        rows.append({"crop": crop.name, "sun": sun, "real": real, "ours": ours, "distances": distances(ours, real)})
    all_frames = [frame for taken in frames for frame in taken]
    real_counts = figures_of(crops)["craters"]
    by_ratio = {f"{ratio:.2f}": figures_of(all_frames, ratio)["craters"] for ratio in DEPTH_RATIOS}
    return {
        "distances": {n: float(np.median([row["distances"][n] for row in rows])) for n in rows[0]["distances"]},
        "crater_log_ratio": {ratio: count_distances(counts, real_counts) for ratio, counts in by_ratio.items()},
        "thresholds_px": THRESHOLDS_PX,
        "craters_per_million_px": {"real": real_counts, **by_ratio},
        "frequency_cycles_per_px": st.FREQUENCY.tolist(),
        "crops": rows,
    }


def draw_sheet(path: Path, crops: list[Picture], frames: list[list[Picture]]) -> None:
    """Draw pairs by ascending Sun: the part of a crop with median contrast, the frame nearest in share of shadow."""
    pairs = []
    for crop, taken in zip(crops, frames, strict=True):
        n = FRAME_PX
        places = [
            (i, j) for i in range(0, crop.image.shape[0] - n + 1, n) for j in range(0, crop.image.shape[1] - n + 1, n)
        ]
        parts = sorted((crop.image[i : i + n, j : j + n] for i, j in places), key=lambda part: part.std() / part.mean())
        real = parts[len(parts) // 2]
        shadow = st.summary(real)["shadow_share"]
        ours = min(taken, key=lambda frame: abs(st.summary(frame.image)["shadow_share"] - shadow)).image
        for image, origin in ((real, "real"), (ours, "ours")):
            shown = np.clip(image * (100 / image.mean()), 0, 255).astype(np.uint8)
            text = f"{origin} {crop.elevation_deg:.0f} deg"
            pairs.append(cv2.putText(shown, text, (6, n - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.5, 255, 1, cv2.LINE_AA))
    write_sheet(path, pairs, 6)


def main(
    folder: Annotated[str, typer.Argument(help="Folder of NAC crops.")] = "",
    preset: str = "small",
    config: Annotated[Path | None, typer.Option()] = None,
    setting: Annotated[list[str] | None, typer.Option("--set")] = None,
    scenes: Annotated[int, typer.Option(min=1, help="Number of terrains.")] = 2,
    sampling: Annotated[float, typer.Option(min=0.05, help="Ground sampling of the crops, metres per pixel.")] = 0.75,
    out: Path = Path("runs/nac"),
) -> None:
    """Compare rendered frames with real NAC crops."""
    if not folder:
        raise UserError("make compare-nac", "NAC", "nothing", "a folder of NAC crops (NAC=folder)")
    resolved = resolve(DatasetConfig, "dataset", "perilune_render", preset, config, tuple(setting or ()))
    crops = read_crops(Path(folder), resolved.terrain.latitude_deg, resolved.terrain.longitude_deg)
    frames = take_frames(resolved, crops, scenes, sampling)
    figures = {"preset": preset, "settings": setting or [], "sampling_m": sampling, "n_scenes": scenes}
    figures |= compare(crops, frames)
    write_figures(out / "nac.json", figures)
    draw_curves(out, figures, [crop.image for crop in crops], [f.image for taken in frames for f in taken])
    draw_sheet(out / "sheet.png", crops, frames)
    print(f"{out}: curves, and sheet.png, which contains real pixels: do not publish it")


if __name__ == "__main__":
    run_command_line(one_command(main))
