"""Random draws and fault scenarios of a Monte Carlo run."""

from dataclasses import dataclass
from typing import Literal

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
