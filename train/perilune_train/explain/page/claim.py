"""One statement on the gates, and the rows of a network's tables that its fields are taken from."""

import math
from dataclasses import asdict, dataclass

import pandas as pd

from perilune_train.explain.evidence.significance import UNDECIDED
from perilune_train.explain.evidence.tables import Evidence
from perilune_train.records.spread import MIN_UNITS


@dataclass(frozen=True)
class Claim:
    """One statement; all fields are texts for a table."""

    claim: str
    """What is claimed, and by whom."""
    figure: str
    """The measured figure."""
    interval: str
    """Its 95 % interval over scenes, or why there is none."""
    nulls: str
    """The same figure of the nulls or controls."""
    verdict: str
    """holds, does not hold, or undecided, with the reason."""
    picture: str
    """File that shows it."""

    def plain(self) -> dict[str, str]:
        """The fields as plain data."""
        return asdict(self)


def decided(holds: bool, scenes: int) -> str:
    """The verdict on a statement that was measured over a number of scenes."""
    return UNDECIDED if scenes < MIN_UNITS else "holds" if holds else "does not hold"


def row_of(found: Evidence, measure: str, name: str) -> pd.Series:
    """The row of the summary of a map and measure."""
    own = found.summary[(found.summary["measure"] == measure) & (found.summary["map"] == name)]
    return own.iloc[0]


def interval_text(row: pd.Series) -> str:
    """The interval of a row of the summary and its units, or that there is none."""
    if math.isfinite(row["low"]) and math.isfinite(row["high"]):
        return f"{row['low']:.2f} to {row['high']:.2f} ({row['n_units']} units: {row['unit']})"
    return f"none: {row['n_units']} units ({row['unit']})"


def scenes_of(rows: pd.DataFrame) -> int:
    """The number of scenes behind rows of a summary: 1 if their units are trajectories of one scene."""
    return int(rows["n_units"].min()) if len(rows) and (rows["unit"] == "scene").all() else 1
