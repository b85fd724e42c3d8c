"""The command `perilune-render frames`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from perilune_render.cli.dataset import JobOptions, finished_or_exit, first_worker
from perilune_render.cli.options import Catalogue, Dem, Preset, Setting, Unit, resolved_config, with_unit
from perilune_render.cli.sun import warn_of_sun
from perilune_render.config.cameras import CameraConfig, LensConfig
from perilune_render.config.dataset import DatasetConfig
from perilune_shared.config.resolve import resolve_over
from perilune_shared.console.terminal import answer
from perilune_shared.dataset.names import Kind
from perilune_shared.errors import UserError
from perilune_shared.storage.store import open_store

if TYPE_CHECKING:
    from perilune_shared.geometry.camera import Camera

Scene = Annotated[
    Path | None,
    typer.Option(help="YAML file whose section `dataset` overrides the preset; `dataset.scene` sets the Sun."),
]
CameraFile = Annotated[
    Path | None,
    typer.Option(
        help="YAML file with the settings of `dataset.camera`, or a calibration of OpenCV, ROS or Kalibr, in place of "
        "the camera of --scene."
    ),
]
CameraAxes = Annotated[
    str | None,
    typer.Option(
        help="Which camera axes of the poses point right, down and forward in the image: `opencv` (x,y,z), "
        "`blender` (x,-y,-z) or three axes. [default: as the file states, else opencv]"
    ),
]


def frames(
    poses: Annotated[
        Path,
        typer.Option(help="Poses: CSV, Parquet, TUM, EuRoC or KITTI; the header states the frame of reference."),
    ],
    out: Annotated[str, typer.Option(help="Folder or address of the new dataset.")],
    scene: Scene = None,
    camera: CameraFile = None,
    camera_axes: CameraAxes = None,
    preset: Preset = "small",
    setting: Setting = None,
    dem: Dem = None,
    height_unit: Unit = None,
    catalogue: Catalogue = None,
    kind: Annotated[
        Kind, typer.Option(help="What the dataset is for: detect (crater detection) or nav (navigation).")
    ] = "nav",
    workers: Annotated[
        int | None, typer.Option(min=0, max=1024, help="Worker processes. [default: one for each core]")
    ] = None,
    threads: Annotated[
        int | None, typer.Option(min=1, max=1024, help="Threads of each process. [default: cores / workers]")
    ] = None,
) -> None:
    """Render frames at given poses over one scene, into an ordinary dataset with labels.

    Run the same command again to resume. Finished trajectories are kept; an interrupted trajectory starts again.
    """
    options = JobOptions.of("local", None, workers, threads, None, finish=False, dry_run=False)
    config = with_camera(
        resolved_config(preset, scene, with_unit(setting, height_unit), dem, catalogue, given_scene=True), camera
    )
    store = open_store(out)
    with first_worker(options, config) as early:
        from perilune_render.dataset.begin import new_info
        from perilune_render.jobs.job import Job
        from perilune_render.poses.file import read_poses
        from perilune_render.poses.plan import given_plan
        from perilune_render.provenance.recipe import recipe_of
        from perilune_render.terrain.scene import site_of

        given_poses = read_poses(poses, *site_of(config), camera_axes)
        plan, config = given_plan(given_poses, config, kind, poses)
        warn_of_sun(config, "sun_elevation_deg", max(scene.sun_elevation_deg for scene in plan.scenes))
        begun = new_info(config, plan, recipe_of(config, kind, preset))
        dataset = finished_or_exit(Job(plan, config, begun, str(poses)), store, options, early)
    if dataset is not None:
        counts = dataset.info.counts
        answer(
            f"{dataset.store}: {counts.frames} frames, {counts.labels} labels; "
            f"look at {dataset.store.at('overview.png')}"
        )


def with_camera(config: DatasetConfig, path: Path | None) -> DatasetConfig:
    """The configuration with the camera of the file `path`; unchanged if `path` is None.

    Raises UserError if `dataset.cameras` is set too.
    """
    if path is None:
        return config
    if config.cameras:
        expected = "--camera or dataset.cameras, not both"
        raise UserError("--camera", "dataset.cameras", ", ".join(config.cameras), expected)
    return config.model_copy(update={"camera": read_camera(path)})


def _lens(camera: "Camera") -> dict[str, Any] | None:
    """The settings `dataset.camera.lens` of a camera."""
    if camera.model == "pinhole":
        return None
    from perilune_shared.geometry.lens_models import PARAMETERS

    named = dict(zip(PARAMETERS[camera.model], camera.parameters, strict=True))
    settings: dict[str, Any] = {name: value for name, value in named.items() if name in LensConfig.model_fields}
    settings["model"] = camera.model
    for vector, names in {"o": ("o_x", "o_y", "o_z"), "r": ("r0", "r1", "r2"), "e": ("e0_m", "e1_m", "e2_m")}.items():
        if names[0] in named:
            settings[vector] = [named[name] for name in names]
    return settings


def read_camera(path: Path) -> CameraConfig:
    """The camera of a file with settings of `dataset.camera` or a calibration of another program.

    Raises UserError if the file cannot be read or its values are invalid.
    """
    # This import loads NumPy, which a command that ends early does not need.
    from perilune_shared.geometry.calibration import Calibration, read_camera_file

    content = read_camera_file(path)
    if isinstance(content, Calibration):
        camera = content.camera
        content = {
            "width_px": camera.width_px,
            "height_px": camera.height_px,
            "focal_length_px": camera.fx_px,
            "focal_length_y_px": camera.fy_px if camera.fy_px != camera.fx_px else None,
            "principal_x_px": camera.cx_px,
            "principal_y_px": camera.cy_px,
            "distortion": dict(zip(("k1", "k2", "p1", "p2", "k3"), camera.distortion, strict=True)),
            "lens": _lens(camera),
        }
    return resolve_over(CameraConfig, "camera", str(path), content)
