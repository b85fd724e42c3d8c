"""Errors of inertial measurement units by grade, to simulate the table `inertial` and for filters.

Each axis has white noise, and a bias that starts at a random value and follows a random walk. A grade may also have
scale factors and misaligned axes, which filters neglect. Quantisation is not simulated.
"""

from dataclasses import dataclass, replace
from typing import Literal

InertialGrade = Literal["cubesat", "tactical", "navigation"]
"""Grade of an inertial measurement unit."""
HOUR_S = 3600.0
STANDARD_GRAVITY_MPS2 = 9.80665


@dataclass(frozen=True, slots=True)
class InertialErrors:
    """Errors of an inertial measurement unit: standard deviations, on each axis."""

    gyro_bias_deg_per_h: float
    """Bias of the angular rate at the start, degrees per hour."""
    gyro_bias_walk_deg_per_h: float
    """Random walk of the angular rate's bias over one hour, degrees per hour."""
    angular_random_walk_deg: float
    """White noise of the angular rate: angle after integration over one hour, degrees."""
    accelerometer_bias_mg: float
    """Bias of the specific force at the start, thousandths of standard gravity."""
    accelerometer_bias_walk_mg: float
    """Random walk of the specific force's bias over one hour, thousandths of standard gravity."""
    velocity_random_walk_mps: float
    """White noise of the specific force: velocity after integration over one hour, metres per second."""
    scale_ppm: float = 0.0
    """Scale factor of each axis of gyroscope and accelerometer, millionths."""
    misalignment_arcsec: float = 0.0
    """Rotation of each axis of gyroscope and accelerometer towards each other axis, seconds of arc."""


GRADES: dict[InertialGrade, InertialErrors] = {
    "cubesat": InertialErrors(30.0, 30.0, 0.3, 3.0, 3.0, 0.1, scale_ppm=1000.0, misalignment_arcsec=200.0),
    "tactical": InertialErrors(10.0, 10.0, 0.1, 1.0, 1.0, 0.06),
    "navigation": InertialErrors(0.01, 0.01, 0.002, 0.05, 0.05, 0.01),
}
"""Errors of each grade.

Biases and noise are within the ranges for tactical and aviation grade in Groves (Principles of GNSS, Inertial, and
Multisensor Integrated Navigation Systems, 2nd edition, 2013, section 4.4). The random walks are our own choice: in one
minute a bias changes by about an eighth of its size. The errors of `cubesat` are our own choice for small
micromechanical units: about three times as large as those of `tactical`, with scale factors and misalignments that
such units have after calibration at the factory."""
CALIBRATED = replace(GRADES["tactical"], gyro_bias_deg_per_h=0.5, gyro_bias_walk_deg_per_h=0.5)
"""Inertial unit of a lander with a star tracker: tactical, with the gyroscope's bias calibrated before the descent."""
