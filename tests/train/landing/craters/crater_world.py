"""A plane with craters, and what a detector with known errors would find of them."""

import numpy as np

from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY, Camera
from perilune_shared.geometry.frames import matrix_from_rotation_vector
from perilune_train.landing.craters.catalogue import Catalogue
from perilune_train.landing.craters.fix import PosePrior
from perilune_train.landing.craters.projection import Pose, projected
from perilune_train.landing.craters.sightings import Sightings

CAMERA = Camera.from_field_of_view(256, 256, 45.0)


def ground_m(position_m):
    """Height of the ground below positions (..., 2 or 3)."""
    return 5 * np.sin(position_m[..., 0] / 300) + 5 * np.cos(position_m[..., 1] / 200)


def world(seed=0, side_m=4000.0, least_m=10.0, per_m2=0.06):
    """Craters with N(>D) = per_m2 D^-2 on rolling ground."""
    rng = np.random.default_rng(seed)
    count = rng.poisson(per_m2 / least_m**2 * side_m**2)
    diameter = least_m * (1 - rng.random(count)) ** -0.5
    xy = rng.uniform(-side_m / 2, side_m / 2, (count, 2))
    z = ground_m(xy)
    normal = np.tile([0.0, 0.0, 1.0], (count, 1))
    order = np.argsort(-diameter)
    return Catalogue(np.column_stack([xy, z])[order], normal, diameter[order] / 2, 0.0, 0.0)


def pose(rng, altitude_m, reach_m=500.0, tilt_deg=0.3, heading_rad=None):
    """A nearly level camera somewhere."""
    heading = rng.uniform(-np.pi, np.pi) if heading_rad is None else heading_rad
    tilt = np.radians(tilt_deg) * rng.normal(size=3) * [1, 1, 0]
    body = matrix_from_rotation_vector([0, 0, heading]) @ matrix_from_rotation_vector(tilt)
    return Pose(np.array([*rng.uniform(-reach_m, reach_m, 2), altitude_m]), ROTATION_CAMERA_FROM_BODY @ body.T)


def sighted(catalogue, true, rng, found_share=0.8, false_share=0.2, most=80, noisy=True, static=True):
    """Detections of a frame at a pose, with the errors that `Sightings` states."""
    seen = projected(catalogue, CAMERA, true)
    large = np.flatnonzero((seen.radius_px > 2) & (seen.radius_px < 50))
    own = large[rng.random(len(large)) < found_share][:most]
    centre, radius = seen.centre_px[own], seen.radius_px[own]
    if noisy:
        stated = Sightings(centre, radius, np.full(len(own), 0.8))
        sigma = np.hypot(stated.noise_px, static * stated.static_px)
        centre = centre + sigma[:, None] * rng.normal(size=centre.shape)
        radius = radius * np.exp(stated.size_sigma * rng.normal(size=len(radius)))
    n_false = round(false_share * len(own))
    centre = np.concatenate([centre, rng.uniform(0, 256, (n_false, 2))])
    radius = np.concatenate([radius, rng.uniform(2, 8, n_false)])
    boxes = np.column_stack([centre - radius[:, None], centre + radius[:, None]])
    return Sightings.of_boxes(boxes, np.full(len(boxes), 0.8))


def nearby(true, shift_m, turn_deg):
    """A weak prior around a pose that is off by so much."""
    off = np.concatenate([shift_m, np.radians(turn_deg)])
    return PosePrior(true.changed(off), np.diag(np.square([300.0] * 3 + [np.radians(3.0)] * 3)))
