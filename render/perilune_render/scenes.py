"""A scene that is rendered in this process, without a server: `perilune.Scene`.

scene = Scene("mare", seed=7, sun_elevation_deg=20)
frame = scene.render(look_down(altitude_m=800, tilt_deg=10))
frame.image, frame.depth_m, frame.labels["radius_px"]
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np
import pandas as pd

from perilune_render.config.dataset import DatasetConfig
from perilune_render.config.scene import SceneConfig
from perilune_render.dataset.tables import ground_tables, label_table
from perilune_render.flight.lens import camera_of
from perilune_render.flight.rig import rig_of
from perilune_render.flight.view import view_of
from perilune_render.labels.frame_labels import Labels
from perilune_render.poses.plan import trajectory_seed
from perilune_render.provenance.recipe import config_of
from perilune_render.server.simulation import SimulatedScene, View, open_simulation, shot_of, simulation_over
from perilune_shared.config.errors import nearest
from perilune_shared.config.resolve import PRESETS, resolve
from perilune_shared.dataset.frame import ELLIPSE_COLUMNS
from perilune_shared.dataset.manifest import Dataset, open_single
from perilune_shared.errors import UserError, one_line
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import sun_direction
from perilune_shared.geometry.poses import Pose, listed
from perilune_shared.labels.selection import selected
from perilune_shared.labels.thresholds import SELECTIONS
from perilune_shared.pictures import GREEN, ORANGE, display, with_ellipses

if TYPE_CHECKING:
    from PIL.Image import Image as Picture

EngineName = Literal["heightfield", "cycles"]
_HIGHLAND = (
    "dataset.light.photometry=hapke_highland",
    "dataset.terrain.relief.rms_slope_deg={low: 5.0, high: 7.0}",
    "dataset.terrain.craters={surface_age_gyr: 4.0, equilibrium_share: {low: 1.2, high: 1.8}}",
    "dataset.terrain.boulders.density=0.15",
)
TERRAINS: dict[str, tuple[str, ...]] = {
    "mare": (
        "dataset.light.photometry=hapke_mare",
        "dataset.terrain.relief.rms_slope_deg={low: 2.0, high: 3.0}",
        "dataset.terrain.boulders.density=0.05",
    ),
    "highland": _HIGHLAND,
    "polar": (*_HIGHLAND, "dataset.terrain.latitude_deg=-85.0", "dataset.scene.sun_elevation_deg=5.0"),
}
"""Named terrains: settings that override the preset `small`.

- `mare`: dark ground, gentle slopes, few boulders (configs/mare.yaml).
- `highland`: bright ground, slopes 2.4 times as steep as in `mare`, denser craters (configs/highland.yaml).
- `polar`: highland ground at latitude -85 degrees, where the Sun is never higher than 6.6 degrees; here it is at 5."""
_BASE = "small"
_CONFIGURATIONS = (".yaml", ".yml")


@dataclass(frozen=True, slots=True, eq=False)
class RenderedFrame:
    """A frame that `Scene.render` returns."""

    image: np.ndarray
    """Grey values, DN (h, w): uint8, or uint16 above 8 bits."""
    depth_m: np.ndarray
    """Depth along the camera's axis, metres (h, w) float32, infinite for the sky. With a lens model, it is the distance
    along the ray. With lens distortion, its pixels belong to a pinhole camera that covers the view, so its shape may
    differ from the shape of `image`."""
    labels: pd.DataFrame
    """One row per crater, with the columns of the table `labels` except `frame_id`, and with the depth and diameter of
    the crater, `depth_m` and `diameter_m`, metres."""
    pose: Pose
    """Pose of the camera."""

    def plot(self) -> "Picture":
        """Return a picture of the frame with the ellipses of its labels.

        Labels that the selection `visible` keeps are green, all others are orange.
        """
        colours = [GREEN if each else ORANGE for each in selected(self.labels, SELECTIONS["visible"])]
        return with_ellipses(self.image, self.labels[ELLIPSE_COLUMNS].to_numpy(), colours)

    def show(self) -> None:
        """Show the picture of `plot` in the notebook or in the system's image viewer."""
        display(self.plot())

    def __repr__(self) -> str:
        height, width = self.image.shape
        return f"RenderedFrame({width} x {height} px, {self.image.dtype}, {len(self.labels)} labels, {self.pose!r})"


class RenderedFrames(Sequence[RenderedFrame]):
    """The N frames of `Scene.render`, one after the other and as stacked arrays.

    With `dataset.render.device=cuda`, the arrays are in the memory of the device, and an item is copied from it. torch,
    JAX and NumPy take an array over by DLPack, on the device without a copy:

        frames = scene.render(poses)
        images = torch.from_dlpack(frames.images)
    """

    def __init__(self, images: Any, depth_m: Any, labels: Sequence[pd.DataFrame], poses: Sequence[Pose]):
        """Keep the arrays; the arguments are described at the properties."""
        self._images, self._depth_m, self._labels, self._poses = images, depth_m, tuple(labels), tuple(poses)

    @property
    def images(self) -> Any:
        """Grey values, DN (N, h, w), uint8, or uint16 above 8 bits: a NumPy array, or an array on the device."""
        return self._images

    @property
    def depth_m(self) -> Any:
        """Depths as in `RenderedFrame`, metres (N, h, w) float32: a NumPy array, or an array on the device."""
        return self._depth_m

    @property
    def labels(self) -> pd.DataFrame:
        """Labels of all frames, as in `RenderedFrame`, with the index of the frame in the column `frame`."""
        tables = [table.assign(frame=index) for index, table in enumerate(self._labels)]
        return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=["frame"])

    @property
    def poses(self) -> tuple[Pose, ...]:
        """Poses of the camera."""
        return self._poses

    def __len__(self) -> int:
        return len(self._poses)

    @overload
    def __getitem__(self, index: int) -> RenderedFrame: ...
    @overload
    def __getitem__(self, index: slice) -> list[RenderedFrame]: ...
    def __getitem__(self, index: int | slice) -> RenderedFrame | list[RenderedFrame]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        k = range(len(self))[index]
        return RenderedFrame(_host(self._images, k), _host(self._depth_m, k), self._labels[k], self._poses[k])

    def __repr__(self) -> str:
        return f"RenderedFrames({len(self)} frames of {self.images.shape[2]} x {self.images.shape[1]} px)"


def _host(images: Any, k: int) -> np.ndarray:
    """Image k in the memory of the processor."""
    return images[k] if isinstance(images, np.ndarray) else images.to_host(k)


class Scene:
    """Lunar ground with craters, a Sun and a camera; renders labelled frames from given poses.

    The ground is large enough for the descents of the configuration, which start at 1500 m by default. A pose from
    which the camera sees beyond this ground raises UserError. To see the horizon, set `dataset.scene.horizon=true`.
    `perilune-render serve` renders equal frames for equal settings and poses. Use a scene in one thread only.

        scene = Scene("mare", seed=7, sun_elevation_deg=20)
        scene.render(look_down(altitude_m=800)).plot().save("frame.png")
    """

    def __init__(
        self,
        source: str | Path | Dataset = "mare",
        *,
        seed: int | None = None,
        sun_elevation_deg: float | None = None,
        sun_azimuth_deg: float | None = None,
        engine: EngineName = "heightfield",
        settings: Sequence[str] = (),
    ):
        """Generate the ground, which takes seconds, or read it from the cache.

        `source` is the name of a terrain (mare, highland, polar) or of a preset, a YAML file of settings, an elevation
        model, a dataset or a manifest. The first scene of a dataset or manifest is used. Arguments left at None keep
        the values of the source. `settings` have the form of `--set`, for example "dataset.camera.width_px=512". The
        engine `cycles` needs Blender. Raises UserError if an argument is invalid.
        """
        arguments: dict[str, Any] = {
            "scene.sun_elevation_deg": sun_elevation_deg,
            "scene.sun_azimuth_deg": sun_azimuth_deg,
            "seed": seed,
        }
        changes = {name: value for name, value in arguments.items() if value is not None}
        changes["render.engine"] = engine
        for name, value in changes.items():
            if not isinstance(value, str | int | float | np.integer | np.floating) or isinstance(value, bool):
                raise UserError("Scene", name.rpartition(".")[2], repr(value), "a number")
        if not isinstance(source, str | Path | Dataset):
            raise UserError("Scene", "source", type(source).__name__, "a name, a path or a dataset")
        every = (*(f"dataset.{name}={value}" for name, value in changes.items()), *settings)
        if isinstance(source, Dataset) or (Path(source) / "dataset.json").is_file() or "://" in str(source):
            if seed is not None or settings:
                raise UserError("Scene", "seed and settings", "given", "neither, since both come from the dataset")
            dataset = source if isinstance(source, Dataset) else open_single(source)
            self.name = str(dataset.store)
            self._simulated = _simulation_of(dataset, sun_azimuth_deg, sun_elevation_deg, engine)
        else:
            self.name = str(source)
            self._simulated = open_simulation(_config_of(source, every))

    @property
    def config(self) -> DatasetConfig:
        """All settings of the scene."""
        return self._simulated.config

    @property
    def camera(self) -> Camera:
        """The camera of the frames."""
        return camera_of(self.config.camera)

    @property
    def craters(self) -> pd.DataFrame:
        """The craters of the ground, one row each, with the columns of the table `craters`."""
        return ground_tables("scene", self._simulated.scene)["craters"].to_pandas()

    @overload
    def render(self, poses: Pose) -> RenderedFrame: ...
    @overload
    def render(self, poses: Sequence[Pose]) -> RenderedFrames: ...
    def render(self, poses: Pose | Sequence[Pose]) -> RenderedFrame | RenderedFrames:
        """Render and label the frame of a pose, or the frames of several poses.

        The index of a pose in the list determines the noise of its frame; a single pose has index 0. On a CUDA device,
        the frames of a list are rendered together and stay there, and the noise differs from the processor's. Raises
        UserError for a pose below the ground, or if the camera sees beyond the ground.
        """
        several = listed(poses)
        if not several:
            return RenderedFrames(np.empty((0, 0, 0), np.uint8), np.empty((0, 0, 0), np.float32), (), ())
        frames = self._render(several)
        return frames[0] if isinstance(poses, Pose) else frames

    def _render(self, poses: Sequence[Pose]) -> RenderedFrames:
        simulated, stated = self._simulated, self.config.scene or SceneConfig()
        sun = sun_direction(stated.sun_azimuth_deg, stated.sun_elevation_deg)
        views = [View(pose.position_m, pose.rotation_camera_from_site, self.camera, sun) for pose in poses]
        seed = trajectory_seed(simulated.scene.seed, 0)
        shots = [
            shot_of(view, seed, index, pose.velocity_mps)
            for index, (view, pose) in enumerate(zip(views, poses, strict=True))
        ]
        batch = simulated.on_device(views, shots)
        if batch is not None:
            frames, labels = batch
            return RenderedFrames(frames.images, frames.rendering.depth_m, list(map(self._rows, labels)), poses)
        images, depths, rows = [], [], []
        for view, shot in zip(views, shots, strict=True):
            frame = simulated.take(view, shot)
            images.append(frame.image)
            depths.append(frame.radiance.depth_m)
            rows.append(self._rows(simulated.labels(view, frame)))
        return RenderedFrames(np.stack(images), np.stack(depths), rows, poses)

    def _rows(self, labels: Labels) -> pd.DataFrame:
        """The table `RenderedFrame.labels`."""
        scene = self._simulated.scene
        rows = label_table("frame", labels).to_pandas().drop(columns="frame_id")
        rim = np.searchsorted(scene.crater_id, labels.crater_id)
        rows["depth_m"] = scene.rims.depth_m[rim]
        rows["diameter_m"] = scene.craters.diameter_m[rim]
        return rows

    def close(self) -> None:
        """Release the engine. It is also released at the end of the program."""
        self._simulated.close()

    def __enter__(self) -> "Scene":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        stated, scene = self.config.scene or SceneConfig(), self._simulated.scene
        about = (
            f"{len(scene.craters)} craters on {scene.grid.extent_m / 1000:.1f} km of ground, Sun at elevation "
            f"{stated.sun_elevation_deg:g} and azimuth {stated.sun_azimuth_deg:g} degrees, {self.camera.width_px} x "
            f"{self.camera.height_px} px, {self.config.render.engine}"
        )
        return one_line(f"Scene({self.name}: {about})")


def _config_of(source: str | Path, settings: tuple[str, ...]) -> DatasetConfig:
    """The settings of a terrain, a preset, a file of settings or an elevation model.

    Raises UserError for any other source.
    """
    name, path = str(source), Path(source)
    preset, file, settings_of_name, dem = _BASE, None, TERRAINS.get(name, ()), None
    if name in PRESETS:
        preset = name
    elif path.suffix.lower() in _CONFIGURATIONS:
        file = path
    elif path.is_file():
        dem = name
    elif name not in TERRAINS:
        known = nearest(name, (*TERRAINS, *PRESETS))
        expected = f"{known}, a YAML file, an elevation model, or the folder of a dataset"
        raise UserError("Scene", "source", name, expected)
    try:
        config = resolve(DatasetConfig, "dataset", "perilune_render", preset, file, (*settings_of_name, *settings))
    except UserError as error:
        if error.where != "--set":
            raise
        raise UserError("Scene", error.field, error.found, error.expected) from None
    for section in ("survey", "counterfactual", "cameras"):
        if getattr(config, section):
            raise UserError("Scene", f"dataset.{section}", "set", "null: a scene has one camera and given poses")
    if dem is not None:
        config = config.model_copy(update={"terrain": config.terrain.model_copy(update={"dem": dem})})
    return config


def _simulation_of(
    dataset: Dataset, sun_azimuth_deg: float | None, sun_elevation_deg: float | None, engine: EngineName
) -> SimulatedScene:
    """The first scene of a dataset; a Sun angle of None keeps the Sun of that scene."""
    info, where = dataset.info, dataset.store.at("dataset.json")
    if len(info.recipes) != 1:
        expected = "one recipe; select its scenes with `perilune-manifest subset`"
        raise UserError(where, "recipes", len(info.recipes), expected)
    recipe = info.recipe()
    terrain = recipe.config.get("terrain")
    if isinstance(terrain, dict) and terrain.get("dem") is not None:
        expected = "procedural ground; give the elevation model itself as the source"
        raise UserError(where, "terrain.dem", terrain["dem"], expected)
    config = config_of(recipe, where)
    if config.survey is not None or config.counterfactual is not None:
        raise UserError(where, "recipe", "a survey or a counterfactual dataset", "a dataset of descents or given poses")
    view = view_of(config, rig_of(config), recipe.kind)
    first: dict[str, Any] = dataset.table("scenes").sort_by("scene_id").slice(0, 1).to_pylist()[0]
    sun = {
        "sun_azimuth_deg": first["sun_azimuth_deg"] if sun_azimuth_deg is None else float(sun_azimuth_deg),
        "sun_elevation_deg": first["sun_elevation_deg"] if sun_elevation_deg is None else float(sun_elevation_deg),
    }
    for name, least, most in (("sun_azimuth_deg", -720, 720), ("sun_elevation_deg", 0, 90)):
        if not least <= sun[name] <= most or sun["sun_elevation_deg"] == 0:
            raise UserError("Scene", name, sun[name], f"{least} to {most}, the elevation above 0")
    lit = (config.scene or SceneConfig()).model_copy(update=sun)
    render = config.render.model_copy(update={"engine": engine})
    return simulation_over(config.model_copy(update={"scene": lit, "render": render}), view, first["seed"])
