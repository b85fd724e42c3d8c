"""Value types shared by several sections of a configuration."""

from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import Field, model_validator
from pydantic_core import core_schema

from perilune_shared.config.resolve import Section

Altitude = Annotated[float, Field(gt=0, le=500_000)]
"""Height above the ground, metres."""
Length = Annotated[float, Field(gt=0, le=1e6)]
"""Length on the ground, metres."""
Deviation = Annotated[float, Field(ge=0, le=10_000)]
"""Standard deviation of a length, metres."""
Seconds = Annotated[float, Field(gt=0, le=100_000)]
"""Duration, seconds."""
Exposure = Annotated[float, Field(gt=0, le=100)]
"""Exposure time, seconds."""
Electrons = Annotated[float, Field(ge=0, le=1e9)]
"""Number of electrons."""
Pixels = Annotated[float, Field(gt=0, le=1e6)]
"""Length in an image, pixels."""
Count = Annotated[int, Field(ge=1, le=1_000_000)]
"""Count of scenes, trajectories or frames."""
Share = Annotated[float, Field(ge=0, le=1)]


@dataclass(frozen=True)
class Within:
    """Bounds on both ends of a Span."""

    least: float
    """Smallest value of `low`."""
    most: float
    """Largest value of `high`."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Return the schema of a Span, followed by the check of its bounds."""
        return core_schema.no_info_after_validator_function(self._check, handler(source))

    def _check(self, span: "Span") -> "Span":
        if span.low < self.least or span.high > self.most:
            raise ValueError(f"{self.least:g} to {self.most:g}")
        return span


class Span(Section):
    """Range of a uniform distribution; in a configuration a single number gives both ends."""

    low: float
    """Smallest value."""
    high: float
    """Largest value."""

    @model_validator(mode="before")
    @classmethod
    def _of_one_number(cls, value: Any) -> Any:
        return {"low": value, "high": value} if isinstance(value, int | float) else value

    @model_validator(mode="after")
    def _ordered(self) -> "Span":
        if self.high < self.low:
            raise ValueError(f"high at least low, {self.low}")
        return self
