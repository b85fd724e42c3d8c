"""Draw random errors for a descent: start errors, inertial errors, and the fault of the scenario."""

from dataclasses import dataclass, replace

import numpy as np

from perilune_shared.geometry.frames import Array
from perilune_shared.geometry.inertial_errors import drawn_errors
from perilune_shared.geometry.inertial_grades import GRADES, InertialGrade
from perilune_train.landing.craters.sightings import Sightings
from perilune_train.landing.filter.flight import Instruments
from perilune_train.landing.methods.seen import SeenDescent
from perilune_train.landing.monte_carlo.scenario import OUTAGE_S, WRONG_PRIOR_M, Scenario


@dataclass(frozen=True, slots=True)
class Draw:
    """One random draw of a descent."""

    descent: SeenDescent
    """The descent, with detections changed as the scenario requires."""
    instruments: Instruments
    """Measurements with the random inertial errors."""
    start_error: Array
    """Error at the start (9,), as in `Start.error`."""


def drawn(
    descent: SeenDescent,
    reference: Instruments,
    grade: InertialGrade,
    sigmas: Array,
    scenario: Scenario,
    rng: np.random.Generator,
) -> Draw:
    """Draw the random errors of one descent.

    `reference` contains inertial measurements whose errors are small compared with the errors of `grade`, so they are
    taken as the true motion. Ranges stay as recorded. `sigmas` are the standard deviations at the start; its first nine
    elements are for position, velocity and attitude.
    """
    start_error = sigmas[:9] * rng.normal(size=9)
    instruments = _measured(reference, grade, rng)
    if scenario == "wrong-prior":
        heading = rng.uniform(0, 2 * np.pi)
        start_error[:2] = WRONG_PRIOR_M * np.array([np.cos(heading), np.sin(heading)])
    elif scenario == "outage":
        duration_s = descent.time_s[-1]
        start_s = rng.uniform(0.0, max(duration_s - OUTAGE_S, 0.0))
        blind = (descent.time_s >= start_s) & (descent.time_s < start_s + OUTAGE_S)
        seen = [
            _none() if dark else frame_sightings for frame_sightings, dark in zip(descent.sightings, blind, strict=True)
        ]
        descent = replace(descent, sightings=seen)
    elif scenario == "false-detections":
        size_px = np.array([descent.camera.width_px, descent.camera.height_px])
        descent = replace(
            descent, sightings=[_with_false(frame_sightings, size_px, rng) for frame_sightings in descent.sightings]
        )
    return Draw(descent, instruments, start_error)


def _measured(reference: Instruments, grade: InertialGrade, rng: np.random.Generator) -> Instruments:
    exact = reference.inertial
    gyro, accelerometer = drawn_errors(GRADES[grade], exact.interval_s, rng)
    rate, force = exact.angular_rate_radps + gyro, exact.specific_force_mps2 + accelerometer
    return replace(reference, inertial=replace(exact, angular_rate_radps=rate, specific_force_mps2=force))


def _none() -> Sightings:
    return Sightings(np.zeros((0, 2)), np.zeros(0), np.zeros(0))


def _with_false(sightings: Sightings, size_px: Array, rng: np.random.Generator) -> Sightings:
    """Add a false sighting for each sighting: equal size and score, at a random position in the image."""
    shuffled = rng.permutation(len(sightings))
    centre = np.concatenate([sightings.centre_px, rng.uniform(0, size_px, (len(sightings), 2))])
    radius = np.concatenate([sightings.radius_px, sightings.radius_px[shuffled]])
    score = np.concatenate([sightings.score, sightings.score[shuffled]])
    order = np.argsort(-radius, kind="stable")
    return Sightings(centre[order], radius[order], score[order])
