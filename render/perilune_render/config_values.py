"""Value types shared by several sections of a configuration."""

from typing import Annotated, Any

from pydantic import Field, model_validator

from perilune_shared.config import Section

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(ge=1)]
Share = Annotated[float, Field(ge=0, le=1)]


class Span(Section):
    """Range of a uniform distribution; in a configuration a single number is a range of that one value."""

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
