"""Run the methods that estimate a position relative to the site: single-frame fixes and the filter."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError
from perilune_train.landing.craters.catalogue import (
    MIN_DIAMETER_M,
    Catalogue,
    CatalogueErrors,
    exact_catalogue,
    with_errors,
)
from perilune_train.landing.methods.fixes import WRONG_PX, fix_summary, fixes_lost_in_space, fixes_near_a_prior
from perilune_train.landing.methods.flights import flight_summary, flights, flights_with_star_tracker
from perilune_train.landing.methods.seen import SeenDescent

SEED = 0
_START_DEG, _STAR_TRACKER_DEG = 0.5, 0.02


@dataclass(frozen=True, slots=True)
class Catalogues:
    """The catalogues of the scenes of a split, by scene_id."""

    exact: Mapping[str, Catalogue]
    """Catalogues without errors."""
    rough: Mapping[str, Catalogue]
    """Catalogues with random errors, like those of catalogues from orbiter images."""
    mapped: Mapping[str, Catalogue]
    """Catalogues from `navigate map`, made by a detector from orbiter images; may be empty."""


def catalogues_of(dataset: Dataset, scene_ids: list[str], mapped: Mapping[str, Catalogue]) -> Catalogues:
    """The catalogues of the given scenes. Raises UserError if the map lacks one of them."""
    exact = {scene: exact_catalogue(dataset, scene, MIN_DIAMETER_M) for scene in scene_ids}
    rough = {
        scene: with_errors(exact[scene], CatalogueErrors(), np.random.default_rng(number))
        for number, scene in enumerate(scene_ids)
    }
    missing = sorted(set(scene_ids) - set(mapped))
    if mapped and missing:
        raise UserError("--map", "scenes", f"none for {missing[0]}", "a map of every scene of the split")
    return Catalogues(exact, rough, {scene: mapped[scene] for scene in scene_ids} if mapped else {})


def absolute_errors(dataset: Dataset, descents: list[SeenDescent], catalogues: Catalogues) -> dict[str, pd.DataFrame]:
    """Errors of each method, one row per frame; methods that have no frames are left out.

    The filter needs inertial measurements of grade `tactical`; without them, only fixes are computed.
    """
    sources = {"": catalogues.rough, ", exact catalogue": catalogues.exact, ", map": catalogues.mapped}
    sources = {name: source for name, source in sources.items() if source}
    tables = {}
    for name, source in sources.items():
        tables[f"fix{name}"] = fixes_near_a_prior(descents, source, SEED)
        tables[f"lost in space{name}"] = fixes_lost_in_space(descents, source, SEED)
    inertial = dataset.table("inertial", ["grade"], *descents[0].ids)
    grades = inertial["grade"].unique().to_pylist()
    if "tactical" in grades:
        for name, source in sources.items():
            tables[f"filter{name}"] = flights(dataset, descents, source, "tactical", _START_DEG)
        tables["filter, star tracker"] = flights(dataset, descents, catalogues.rough, "tactical", _STAR_TRACKER_DEG)
        if "navigation" in grades:
            tables["filter, star tracker in flight"] = flights_with_star_tracker(
                dataset, descents, catalogues.rough, _START_DEG
            )
        if any(seen.sigma_px is not None for descent in descents for seen in descent.sightings):
            unaided = [
                replace(descent, sightings=[seen.without_predictions() for seen in descent.sightings])
                for descent in descents
            ]
            tables["filter, constant deviations"] = flights(dataset, unaided, catalogues.rough, "tactical", _START_DEG)
            if "navigation" in grades:
                tables["filter, star tracker in flight, constant deviations"] = flights_with_star_tracker(
                    dataset, unaided, catalogues.rough, _START_DEG
                )
        tables["smoother"] = flights(dataset, descents, catalogues.rough, "tactical", _START_DEG, smooth=True)
    return {name: table for name, table in tables.items() if len(table)}


def absolute_summary(method: str, errors: pd.DataFrame) -> dict[str, float]:
    """Metrics of a method, from its table in `absolute_errors`."""
    return fix_summary(errors) if method.startswith(("fix", "lost")) else flight_summary(errors)


def on_the_same_frames(errors: Mapping[str, pd.DataFrame]) -> dict[str, dict[str, float]]:
    """Compare fixes and filter on the same frames; keys are the names of the fix methods.

    `fix_summary` uses correct fixes only, and in hard frames fixes are rarely correct. The RMSE of fixes and the RMSE
    of the filter are therefore comparable only on frames with a correct fix. `filter_better_share` is the share of all
    frames in which the filter's error is smaller; a frame without a fix counts for the filter.
    """
    compared = {}
    for fix in ("fix", "fix, exact catalogue", "fix, map"):
        flown = fix.replace("fix", "filter")
        if fix not in errors or flown not in errors:
            continue
        # Both tables have one row per frame, in the order of time in each trajectory.
        pair = _by_frame(errors[fix]).join(
            _by_frame(errors[flown])[["error_m"]], lsuffix="_fix", rsuffix="_filter", how="inner"
        )
        right = pair[pair["error_px"] < WRONG_PX]
        worse = ~(pair["error_m_fix"] <= pair["error_m_filter"])
        compared[fix] = {
            "n_frames": float(len(right)),
            "fix_rmse_m": float(np.sqrt(np.mean(np.square(right["error_m_fix"])))),
            "filter_rmse_m": float(np.sqrt(np.mean(np.square(right["error_m_filter"])))),
            "filter_better_share": float(worse.mean()),
        }
    return compared


def _by_frame(table: pd.DataFrame) -> pd.DataFrame:
    """The errors of a method, indexed by scene, trajectory and number of the frame."""
    keys = ["scene_id", "trajectory_id"]
    number = table.groupby(keys).cumcount()
    columns = [name for name in ("error_m", "error_px") if name in table]
    return table.assign(frame=number).set_index([*keys, "frame"])[columns]
