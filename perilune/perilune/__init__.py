"""Find lunar craters, render labelled scenes, read datasets, and run a filter over a landing.

    import perilune

    craters = perilune.load_detector()("photo.png")
    craters.table, craters.plot()

    scene = perilune.Scene("mare", seed=7, sun_elevation_deg=20)
    frame = scene.render(perilune.look_down(altitude_m=800, tilt_deg=10))
    frame.image, frame.depth_m, frame.labels

    dataset = perilune.open_dataset("data/small/detect")
    dataset[0].show()
    frames = dataset.torch(split="train", selection="visible")

    estimates = perilune.fly("descent", detector=my_function)

The detector, `dataset.torch` and `fly` need the extra `train`; scenes need the extra `render`. A part is imported when
one of its names is first used.
"""

from typing import TYPE_CHECKING, Any

from perilune.parts import MissingPart, part
from perilune_shared.errors import UserError

if TYPE_CHECKING:
    from perilune.datasets import Dataset as Dataset
    from perilune.datasets import open_dataset as open_dataset
    from perilune_render.scenes import RenderedFrame as RenderedFrame
    from perilune_render.scenes import RenderedFrames as RenderedFrames
    from perilune_render.scenes import Scene as Scene
    from perilune_shared.geometry.poses import Pose as Pose
    from perilune_shared.geometry.poses import descent as descent
    from perilune_shared.geometry.poses import look_at as look_at
    from perilune_shared.geometry.poses import look_down as look_down
    from perilune_train.detect.images.find import CraterDetector as CraterDetector
    from perilune_train.detect.images.find import Craters as Craters
    from perilune_train.detect.images.find import load_detector as load_detector
    from perilune_train.landing.fly.from_python import fly as fly
    from perilune_train.landing.fly.run import DescentFiles as DescentFiles

__version__ = "0.1.0"
_MODULES = {
    "perilune.datasets": ("Dataset", "open_dataset"),
    "perilune_render.scenes": ("RenderedFrame", "RenderedFrames", "Scene"),
    "perilune_shared.geometry.poses": ("Pose", "descent", "look_at", "look_down"),
    "perilune_train.detect.images.find": ("CraterDetector", "Craters", "load_detector"),
    "perilune_train.landing.fly.from_python": ("fly",),
    "perilune_train.landing.fly.run": ("DescentFiles",),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}
__all__ = [
    "CraterDetector",
    "Craters",
    "Dataset",
    "DescentFiles",
    "MissingPart",
    "Pose",
    "RenderedFrame",
    "RenderedFrames",
    "Scene",
    "UserError",
    "descent",
    "fly",
    "load_detector",
    "look_at",
    "look_down",
    "open_dataset",
]


def __getattr__(name: str) -> Any:
    """Import the part that defines a name, and return the object. Raises MissingPart."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(part(_MODULE_OF[name], name), name)


def __dir__() -> list[str]:
    return __all__
