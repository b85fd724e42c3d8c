"""Settings of a Monte Carlo run: number of draws, fault scenario, sensors and outages."""

from dataclasses import dataclass, replace
from typing import Literal

from perilune_shared.geometry.inertial_grades import CALIBRATED, GRADES, InertialErrors

Scenario = Literal["nominal", "outage", "wrong-prior", "false-detections"]
"""Name of a scenario."""
OUTAGE_S, WRONG_PRIOR_M = 10.0, 300.0
SCENARIOS: dict[Scenario, str] = {
    "nominal": "nothing goes wrong",
    "outage": f"no detections for {OUTAGE_S:g} s at a random time",
    "wrong-prior": f"the start is {WRONG_PRIOR_M:g} m off over ground, and states 60 m on each axis",
    "false-detections": "a false detection is added for each detection",
}
"""Description of each scenario."""
Unit = Literal["cubesat", "tactical", "calibrated"]
"""Name of an inertial unit."""
UNITS: dict[Unit, InertialErrors] = {
    "cubesat": GRADES["cubesat"],
    "tactical": GRADES["tactical"],
    "calibrated": CALIBRATED,
}
"""Errors of the inertial units; `calibrated` is a tactical unit with a gyroscope bias of 0.5 degrees per hour."""
Altimeter = Literal["drawn", "recorded", "none"]
ALTIMETERS: dict[Altimeter, str] = {
    "drawn": "the recorded ranges, with further noise of the altimeter in each draw",
    "recorded": "the recorded ranges in all draws",
    "none": "no altimeter",
}
"""Description of the ranges of the altimeter."""
Detections = Literal["recorded", "drawn"]
DETECTIONS: dict[Detections, str] = {
    "recorded": "all draws of a descent use the recorded detections, with the same errors",
    "drawn": "centres and sizes of matched detections are drawn from the errors measured on the recorded detections",
}
"""Description of the detections."""


@dataclass(frozen=True, slots=True)
class Sensors:
    """Sensors of the lander, and the lengths of their outages at a random time of each flight."""

    unit: Unit = "tactical"
    """Inertial unit."""
    scale_ppm: float | None = None
    """Standard deviation of the unit's scale factors, millionths; None for the value of the unit."""
    misalignment_arcsec: float | None = None
    """Standard deviation of the misalignments of the unit's axes, seconds of arc; None for the value of the unit."""
    altimeter: Altimeter = "drawn"
    """Ranges of the altimeter."""
    star_tracker_hz: float = 0.0
    """Attitudes of the star tracker per second; 0 without a star tracker."""
    doppler_hz: float = 0.0
    """Measurements of each beam of the Doppler lidar per second; 0 without a Doppler lidar."""
    star_tracker_outage_s: float = 0.0
    """Time without attitudes, seconds."""
    altimeter_outage_s: float = 0.0
    """Time without ranges, seconds."""
    detections_outage_s: float = 0.0
    """Time without detections, seconds."""

    @property
    def inertial(self) -> InertialErrors:
        """Errors of the inertial unit."""
        errors = UNITS[self.unit]
        if self.scale_ppm is not None:
            errors = replace(errors, scale_ppm=self.scale_ppm)
        if self.misalignment_arcsec is not None:
            errors = replace(errors, misalignment_arcsec=self.misalignment_arcsec)
        return errors


@dataclass(frozen=True, slots=True)
class Draws:
    """Random draws of every descent of a Monte Carlo run."""

    scenario: Scenario = "nominal"
    """Name of the fault scenario."""
    count: int = 200
    """Number of draws of each descent."""
    attitude_deg: float = 0.5
    """Standard deviation of the attitude at the start about each axis, degrees."""
    seed: int = 0
    """Random seed of all draws."""
    first: int = 0
    """Number of the first draw."""
    sensors: Sensors = Sensors()
    """Sensors and their outages."""
    detections: Detections = "recorded"
    """Whether the errors of detections are drawn."""

    @property
    def detections_outage_s(self) -> float:
        """Time without detections, seconds, by the sensors' outages or the scenario."""
        return max(self.sensors.detections_outage_s, OUTAGE_S if self.scenario == "outage" else 0.0)
