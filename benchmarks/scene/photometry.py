"""Compare rendered radiance with the photometric laws, over all directions of light and view.

For each law and phase angle, one image of a mosaic of small tilted planes is rendered through the project's own
material, lamp and Cycles settings into an EXR. Every pixel whose four corners lie on one plane is compared with the law
at the angles of that pixel. The planes cast no shadows, and the Sun is a point: a disc of 0.5 degrees would average the
law over directions, which is physically correct but differs from the formula. Writes runs/bench/photometry.json.
"""

import tempfile
from pathlib import Path
from typing import get_args

import numpy as np

from benchmarks.figures import write_figures
from perilune_render.config.dataset import LightConfig, RenderConfig
from perilune_render.engines.blender import bpy
from perilune_render.engines.blender.renderer import configure, render_through
from perilune_render.engines.blender.stage import aim, mesh_from_arrays, sunlit_stage, surface_material
from perilune_shared.console.terminal import progress_bar
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.ellipse import plane_basis
from perilune_shared.geometry.frames import Array, sun_direction
from perilune_shared.photometry import radiance_factor

PHASE_DEG = (0, 0.5, 1, 2, 5, 10, 20, 30, 45, 60, 75, 90, 105, 120, 135, 140)
EMISSION_DEG = np.arange(0, 61, 5)
AZIMUTH_DEG = np.arange(0, 360, 15)
LARGEST_INCIDENCE_DEG = 85.0
CELL_PX = 18
HEIGHT_M = 100.0
ROTATION_CAMERA_FROM_SITE = np.diag([1.0, -1.0, -1.0])


def main() -> None:
    """Run the benchmark."""
    n_cells = int(np.ceil(np.sqrt(len(EMISSION_DEG) * len(AZIMUTH_DEG))))
    # A field of view of half a degree, so that the phase angle is nearly constant over an image.
    camera = Camera.from_field_of_view(n_cells * CELL_PX, n_cells * CELL_PX, 0.5)
    cell_m = CELL_PX * HEIGHT_M / camera.fx_px
    laws = get_args(LightConfig.model_fields["photometry"].annotation)
    errors: dict[str, list[Array]] = {law: [] for law in laws}
    n_geometries = 0
    with tempfile.TemporaryDirectory() as folder, progress_bar() as bar:
        for law in bar.track(laws, description="laws"):
            for phase_deg in PHASE_DEG:
                sun = sun_direction(30.0, 90.0 - phase_deg)
                normals = tilted_normals(sun)
                cells = np.stack(np.divmod(np.arange(len(normals)), n_cells), axis=1)[:, ::-1]
                centres = np.pad((cells - (n_cells - 1) / 2) * cell_m, ((0, 0), (0, 1)))
                image = render_planes(Path(folder), law, camera, sun, normals, centres, 0.4 * cell_m)
                view, plane = pixels_on_planes(camera, normals, centres, 0.4 * cell_m)
                on = plane >= 0
                normal = normals[plane[on]]
                mu = np.sum(view[on] * normal, axis=-1)
                expected = radiance_factor(law, normal @ sun, mu, view[on] @ sun)
                errors[law].append(np.abs(image[on] / expected - 1))
                n_geometries += len(np.unique(plane[on]))
    both = np.concatenate([np.concatenate(parts) for parts in errors.values()])
    figures = {
        "worst_relative": float(both.max()),
        "median_relative": float(np.median(both)),
        "laws": {law: law_figures(parts) for law, parts in errors.items()},
        "pixels": len(both),
        "geometries": n_geometries,
    }
    write_figures(Path("runs/bench/photometry.json"), figures)


def tilted_normals(sun: Array) -> Array:
    """Sunlit normals (N, 3) at all emission angles and azimuths about the camera's axis."""
    emission, azimuth = (a.ravel() for a in np.radians(np.meshgrid(EMISSION_DEG, AZIMUTH_DEG, indexing="ij")))
    flat = np.sin(emission)
    normals = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.cos(emission)], axis=1)
    return normals[normals @ sun >= np.cos(np.radians(LARGEST_INCIDENCE_DEG))]


def corners(normals: Array, centres_m: Array, half_m: float) -> Array:
    """Corners (N, 4, 3), metres, of square planes of half side `half_m`."""
    sides = [plane_basis(normal) for normal in normals]
    return np.stack(
        [c + half_m * np.array([-x - y, x - y, x + y, y - x]) for c, (x, y) in zip(centres_m, sides, strict=True)]
    )


def render_planes(
    folder: Path, law: str, camera: Camera, sun: Array, normals: Array, centres_m: Array, half_m: float
) -> np.ndarray:
    """Radiance factor (h, w) of the planes."""
    light = LightConfig.model_validate({"photometry": law, "sun_angular_diameter_deg": 0.0})
    stage = sunlit_stage(light, camera, sun)
    points = corners(normals, centres_m, half_m).reshape(-1, 3)
    mesh = mesh_from_arrays("planes", points, np.arange(len(points)).reshape(-1, 4))
    mesh.materials.append(surface_material("planes", law, sun))
    planes = bpy.data.objects.new("planes", mesh)
    planes.visible_shadow = False
    stage.collection.objects.link(planes)
    configure(stage, camera, RenderConfig(samples=4), light)
    aim(stage, np.array([0, 0, HEIGHT_M]), ROTATION_CAMERA_FROM_SITE)
    return render_through(folder / "frame.exr", stage, 0).radiance_factor


def pixels_on_planes(camera: Camera, normals: Array, centres_m: Array, half_m: float) -> tuple[Array, np.ndarray]:
    """Direction to the camera (h, w, 3), and the plane (h, w) that contains the whole pixel, -1 for none."""
    rays = camera.rays(camera.pixel_centres()) @ ROTATION_CAMERA_FROM_SITE
    view = -rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    plane = np.full(view.shape[:2], -1)
    position = np.array([0, 0, HEIGHT_M])
    pixels = camera.project((centres_m - position) @ ROTATION_CAMERA_FROM_SITE.T)
    for k, normal in enumerate(normals):
        x, y = plane_basis(normal)
        column, row = (round(float(p)) for p in pixels[k])
        box = slice(max(row - CELL_PX, 0), row + CELL_PX), slice(max(column - CELL_PX, 0), column + CELL_PX)
        inside = np.ones(plane[box].shape, bool)
        for offset in ((-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.5)):
            corner = camera.rays(camera.pixel_centres()[box] + np.array(offset)) @ ROTATION_CAMERA_FROM_SITE
            along = ((centres_m[k] - position) @ normal) / (corner @ normal)
            place = position + corner * along[..., None] - centres_m[k]
            inside &= np.maximum(np.abs(place @ x), np.abs(place @ y)) < 0.99 * half_m
        plane[box][inside] = k
    return view, plane


def law_figures(errors: list[Array]) -> dict[str, object]:
    """Figures of one law, with the largest error of each phase angle."""
    both = np.concatenate(errors)
    return {
        "worst_relative": float(both.max()),
        "median_relative": float(np.median(both)),
        "pixels": len(both),
        "worst_relative_by_phase_deg": {
            str(g): float(part.max()) for g, part in zip(PHASE_DEG, errors, strict=True) if len(part)
        },
    }


if __name__ == "__main__":
    main()
