"""State of one client of PANGU's protocol: camera, Sun and images."""

from dataclasses import dataclass, field

import numpy as np

from perilune_render.server.pangu import messages as m
from perilune_render.server.pangu.view import RollSense, SunZero, camera_from_angles, rotation_from_angles
from perilune_render.server.pangu.wire import unsigned
from perilune_render.server.simulation import SimulatedScene, View
from perilune_shared.geometry.frames import Array

CAMERAS = (0, 1)
"""Numbers by which the single camera of a session can be addressed."""
_START_M = 1000.0


@dataclass(frozen=True, slots=True)
class Conventions:
    """Options for PANGU's undocumented conventions, and whether a client may stop the server."""

    sun_zero: SunZero = "clockwise-from-y"
    """How the Sun's azimuth is counted."""
    roll_sense: RollSense = "left"
    """Side to which positive roll leans the top of the camera."""
    may_quit: bool = False
    """Whether a client may stop the server."""


@dataclass
class Session:
    """State of one client."""

    simulated: SimulatedScene
    """The scene."""
    width_px: int
    """Width of all images, pixels."""
    height_px: int
    """Height of all images, pixels."""
    field_of_view_rad: float
    """Horizontal field of view, radians."""
    sun: Array
    """Unit vector towards the Sun (3,)."""
    seed: int
    """Random seed of the noise in this client's images."""
    conventions: Conventions = Conventions()
    """Options."""
    aspect: float = 1.0
    """Height of a pixel divided by its width."""
    position_m: Array = field(default_factory=lambda: np.array([0.0, 0.0, _START_M]))
    """Position of the camera, O_L, metres (3,); at first above the site."""
    rotation_camera_from_site: Array = field(default_factory=lambda: rotation_from_angles(0.0, -np.pi / 2, 0.0))
    """Rotation matrix (3, 3); at first the camera looks straight down."""
    velocity_mps: Array = field(default_factory=lambda: np.zeros(3))
    """Velocity of the camera, O_L, metres per second (3,); blurs images."""
    n_images: int = 0
    """Number of images so far. It selects the noise of the next image."""
    asked_us: float = 0.0
    """Time at which the current message arrived, microseconds since 1970."""
    time_tag_us: float | None = None
    """Time of the request for the last image that was sent, microseconds since 1970; None before the first."""

    def view(self) -> View:
        """The current view."""
        camera = camera_from_angles(self.width_px, self.height_px, self.field_of_view_rad, self.aspect)
        return View(self.position_m, self.rotation_camera_from_site, camera, self.sun)

    def image(self) -> bytes:
        """The image of the current view, as a message."""
        frame = self.simulated.frame(self.view(), self.seed, self.n_images, self.velocity_mps)
        self.n_images += 1
        self.time_tag_us = self.asked_us
        grey = frame.image if frame.image.dtype == np.uint8 else frame.image >> (self.simulated.config.sensor.bits - 8)
        return picture(grey.astype(np.uint8))


def check_camera(number: int) -> None:
    """Raise ValueError if no camera has this number."""
    if number not in CAMERAS:
        raise ValueError(f"camera {number}, expected 0 or 1")


def picture(grey: np.ndarray) -> bytes:
    """Encode grey values (h, w) uint8 as an image message: a PPM file with three equal channels, as PANGU sends."""
    height, width = grey.shape
    content = b"P6\n%d %d 255\n" % (width, height) + np.repeat(grey[..., None], 3, axis=2).tobytes()
    return unsigned(m.IMAGE, len(content)) + content
