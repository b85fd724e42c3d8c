"""Draw the random errors of one flight: start, catalogue, sensors, detections, and the fault of the scenario.

Each kind of error has a generator that depends on the seed, the descent, the draw and the name of the error. So a draw
can be repeated alone, and another sensor does not change the errors of the others.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from perilune_shared.geometry.frames import Array
from perilune_shared.geometry.inertial_errors import drawn_axes, drawn_errors
from perilune_shared.geometry.inertial_grades import InertialErrors
from perilune_train.landing.craters.catalogue import Catalogue, CatalogueErrors, with_errors
from perilune_train.landing.craters.sightings import Sightings
from perilune_train.landing.filter.flight import DopplerLidar, Instruments, StarTracker
from perilune_train.landing.filter.lander import Beam, LidarErrors
from perilune_train.landing.filter.state import rotation_matrices
from perilune_train.landing.methods.detector_errors import DetectorErrors, FrameMatches, drawn_sightings
from perilune_train.landing.methods.flights import STAR_TRACKER_ARCSEC
from perilune_train.landing.methods.seen import SeenDescent
from perilune_train.landing.monte_carlo.motion import TrueMotion
from perilune_train.landing.monte_carlo.scenario import WRONG_PRIOR_M, Draws

ALTIMETER_M, ALTIMETER_SHARE = 0.2, 0.0005
"""Standard deviation of a range: metres, and a share of the range. These are the defaults of simulated altimeters."""
DOPPLER_SPEED_MPS, DOPPLER_RANGE_M = 0.02, 2.0
"""Standard deviations of a speed and a range along a beam of the Doppler lidar."""
_AROUND = np.radians([0.0, 120.0, 240.0])
_FROM_DOWN = float(np.radians(22.5))
DOPPLER_BEAMS = np.column_stack(
    [np.sin(_FROM_DOWN) * np.cos(_AROUND), np.sin(_FROM_DOWN) * np.sin(_AROUND), np.full(3, -np.cos(_FROM_DOWN))]
)
"""Directions of the three beams (3, 3), O_B, 22.5 degrees from -Z_B."""


@dataclass(frozen=True, slots=True)
class Site:
    """One descent and the inputs of its draws."""

    descent: SeenDescent
    """The descent with the detections in its frames."""
    reference: Instruments
    """Inertial measurements whose errors are small, taken as the true motion, and the recorded ranges."""
    catalogue: Catalogue
    """Craters without errors."""
    motion: TrueMotion
    """True motion between the frames."""
    matches: list[FrameMatches]
    """Detections of each frame that match a true crater."""
    errors: DetectorErrors | None = None
    """Errors from which detections are drawn; None if the recorded detections are used."""


@dataclass(frozen=True, slots=True)
class Draw:
    """One random draw of a descent."""

    descent: SeenDescent
    """The descent, with detections changed as the settings require."""
    instruments: Instruments
    """Measurements with the random errors."""
    catalogue: Catalogue
    """Craters with the random errors of the catalogue."""
    start_error: Array
    """Error at the start (9,), as in `Start.error`."""


@dataclass(frozen=True, slots=True)
class Streams:
    """Random generators of one draw, derived by name."""

    seed: int
    """Random seed of all draws."""
    ids: tuple[str, str]
    """scene_id and trajectory_id."""
    draw: int
    """Number of the draw."""

    def of(self, name: str) -> np.random.Generator:
        """The generator of one kind of error."""
        text = "\x1f".join([str(self.seed), *self.ids, str(self.draw), name])
        return np.random.default_rng(int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "little"))


def drawn(site: Site, draws: Draws, sigmas: Array, number: int) -> Draw:
    """Draw the random errors of one flight of a descent.

    `sigmas` are the standard deviations at the start; the first nine are for position, velocity and attitude. `number`
    is the number of the draw.
    """
    streams = Streams(draws.seed, site.descent.ids, number)
    start_error = sigmas[:9] * streams.of("start").normal(size=9)
    if draws.scenario == "wrong-prior":
        heading = streams.of("wrong prior").uniform(0, 2 * np.pi)
        start_error[:2] = WRONG_PRIOR_M * np.array([np.cos(heading), np.sin(heading)])
    catalogue = with_errors(site.catalogue, CatalogueErrors(), streams.of("catalogue"))
    return Draw(_seen(site, draws, streams), _instruments(site, draws, streams), catalogue, start_error)


def _instruments(site: Site, draws: Draws, streams: Streams) -> Instruments:
    sensors, reference, end_s = draws.sensors, site.reference, float(site.descent.time_s[-1])
    inertial = _measured(reference, sensors.inertial, streams.of("inertial unit"))
    time_s, range_m = reference.range_time_s, reference.range_m
    if sensors.altimeter == "none":
        time_s, range_m = np.zeros(0), np.zeros(0)
    elif sensors.altimeter == "drawn":
        sigma_m = ALTIMETER_M + ALTIMETER_SHARE * range_m
        range_m = range_m + sigma_m * streams.of("altimeter").normal(size=len(range_m))
    blind = outage(time_s, end_s, sensors.altimeter_outage_s, streams.of("altimeter outage"))
    stars = lidar = None
    if sensors.star_tracker_hz > 0:
        at = site.motion.at_rate(sensors.star_tracker_hz)
        dark = outage(at.time_s, end_s, sensors.star_tracker_outage_s, streams.of("star tracker outage"))
        stars = _attitudes(at, dark, streams.of("star tracker"))
    if sensors.doppler_hz > 0:
        lidar = _beams(site.motion.at_rate(sensors.doppler_hz), 1 / sensors.doppler_hz, streams.of("Doppler lidar"))
    return Instruments(inertial.inertial, time_s, np.where(blind, np.nan, range_m), stars, lidar)


def _measured(reference: Instruments, errors: InertialErrors, rng: np.random.Generator) -> Instruments:
    exact = reference.inertial
    gyro, accelerometer = drawn_errors(errors, exact.interval_s, rng)
    gyro_axes, accelerometer_axes = drawn_axes(errors, rng)
    rate = exact.angular_rate_radps @ gyro_axes.T + gyro
    force = exact.specific_force_mps2 @ accelerometer_axes.T + accelerometer
    return replace(reference, inertial=replace(exact, angular_rate_radps=rate, specific_force_mps2=force))


def _attitudes(at: TrueMotion, dark: NDArray[np.bool_], rng: np.random.Generator) -> StarTracker:
    sigmas_rad = np.radians(np.array(STAR_TRACKER_ARCSEC) / 3600)
    turns = rotation_matrices(sigmas_rad * rng.normal(size=(len(at.time_s), 3)))
    measured = np.swapaxes(at.rotation_site_from_body @ turns, 1, 2)
    measured[dark] = np.nan
    return StarTracker(at.time_s, measured, sigmas_rad)


def _beams(at: TrueMotion, step_s: float, rng: np.random.Generator) -> DopplerLidar:
    """Speeds along the beams. Ranges are missing, because the ground at the ends of the beams is not in the dataset."""
    along = np.einsum("ni,nij,bj->nb", at.velocity_mps, at.rotation_site_from_body, DOPPLER_BEAMS)
    speeds = along + DOPPLER_SPEED_MPS * rng.normal(size=along.shape)
    beams = [
        Beam(direction, float(speed), np.nan)
        for row in speeds
        for direction, speed in zip(DOPPLER_BEAMS, row, strict=True)
    ]
    return DopplerLidar(np.repeat(at.time_s, 3), beams, LidarErrors(DOPPLER_SPEED_MPS, DOPPLER_RANGE_M, step_s))


def outage(time_s: Array, end_s: float, duration_s: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Whether each time lies in an outage of the given duration (n,), which begins at a random time before `end_s`."""
    start_s = rng.uniform(0.0, max(end_s - duration_s, 0.0))
    return (time_s >= start_s) & (time_s < start_s + duration_s)


def _seen(site: Site, draws: Draws, streams: Streams) -> SeenDescent:
    descent = site.descent
    sightings: Sequence[Sightings] = descent.sightings
    if site.errors is not None:
        sightings = drawn_sightings(descent, site.matches, site.errors, streams.of("detections"))
    if draws.detections_outage_s > 0:
        end_s = float(descent.time_s[-1])
        blind = outage(descent.time_s, end_s, draws.detections_outage_s, streams.of("detections outage"))
        sightings = [_NOTHING if dark else frame for frame, dark in zip(sightings, blind, strict=True)]
    if draws.scenario == "false-detections":
        size_px, rng = np.array([descent.camera.width_px, descent.camera.height_px]), streams.of("false detections")
        sightings = [_with_false(frame, size_px, rng) for frame in sightings]
    return descent if sightings is descent.sightings else replace(descent, sightings=list(sightings))


_NOTHING = Sightings(np.zeros((0, 2)), np.zeros(0), np.zeros(0))


def _with_false(sightings: Sightings, size_px: Array, rng: np.random.Generator) -> Sightings:
    """Add a false sighting for each sighting: the size, score and predicted deviation of one, at a random position."""
    shuffled = rng.permutation(len(sightings))
    centre = np.concatenate([sightings.centre_px, rng.uniform(0, size_px, (len(sightings), 2))])
    twice = sightings.part(np.concatenate([np.arange(len(sightings)), shuffled]))
    return replace(twice, centre_px=centre).part(np.argsort(-twice.radius_px, kind="stable"))
