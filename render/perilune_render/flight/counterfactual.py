"""Plan of a counterfactual: frames of a dataset, and the craters that are removed from its ground.

The removed craters are so far apart that one rendering without all of them shows the effect of each removal alone.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from perilune_render.flight.plan import Plan, TrajectoryPlan
from perilune_render.flight.trajectories import Flight
from perilune_render.streams import stream
from perilune_render.terrain.albedo import RAYED_WEAR, RAYS_REACH
from perilune_render.terrain.craters.population import diffusivity_m2_per_myr
from perilune_render.terrain.craters.removal import REACH_RADII
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError
from perilune_shared.labels.selection import read_labels, selected
from perilune_shared.labels.thresholds import SELECTIONS

REMOVED_COLUMNS = {
    "scene_id": "str",
    "crater_id": "int64",
    "seed": "int64",
    "x_m": "float64",
    "y_m": "float64",
    "diameter_m": "float64",
    "depth_ratio": "float64",
    "reach_m": "float64",
    "n_frames": "int64",
}
"""Columns of the table of removed craters, and their types.

scene_id and crater_id come from the dataset, and `seed` is the random seed of the scene. x_m and y_m are the centre
in O_L, depth_ratio is the ratio of depth to diameter, and `reach_m` is the distance within which the removal changes
the ground. n_frames counts the planned frames in which the crater is visible.
"""
_CRATER = ("scene_id", "crater_id", "x_m", "y_m", "age_myr", "origin")
_N_SIZES, _N_DEPTHS = 3, 2


def part_of(plan: Plan, split: str, n_frames: int, sun_azimuth_offset_deg: float = 0.0) -> Plan:
    """At most `n_frames` frames of each trajectory, evenly spaced over its frames in one split.

    The azimuth of the Sun is turned by `sun_azimuth_offset_deg`. Frames keep their ids, poses and random seeds.
    Trajectories and scenes without frames in the split are omitted. Raises UserError if no frame is in the split.
    """
    trajectories: list[TrajectoryPlan] = []
    ranges: dict[str, range] = {}
    for scene in plan.scenes:
        first = len(trajectories)
        trajectories += [part for each in plan.of_scene(scene.scene_id) if (part := _part(each, split, n_frames))]
        if len(trajectories) > first:
            ranges[scene.scene_id] = range(first, len(trajectories))
    if not ranges:
        raise UserError("--split", "", f"no frame in {split}", "a split that has frames")
    scenes = tuple(
        replace(scene, sun_azimuth_deg=(scene.sun_azimuth_deg + sun_azimuth_offset_deg) % 360)
        for scene in plan.scenes
        if scene.scene_id in ranges
    )
    return replace(plan, scenes=scenes, trajectories=tuple(trajectories), ranges=ranges)


def _part(trajectory: TrajectoryPlan, split: str, n_frames: int) -> TrajectoryPlan | None:
    """Some frames of a trajectory, or None if no frame is in the split."""
    in_split = np.flatnonzero(np.array(trajectory.splits) == split)
    if not len(in_split):
        return None
    chosen = in_split[np.unique(np.linspace(0, len(in_split) - 1, min(n_frames, len(in_split))).round().astype(int))]
    index = tuple(trajectory.frame_index[number] for number in chosen)
    splits = (split,) * len(chosen)
    return replace(trajectory, frame_index=index, splits=splits, draw_flight=partial(_flight, trajectory, chosen))


def _flight(trajectory: TrajectoryPlan, indices: np.ndarray) -> Flight:
    """The flight of a trajectory with the poses of some of its frames."""
    whole = trajectory.flight
    return replace(
        whole,
        time_s=whole.time_s[indices],
        position_m=whole.position_m[indices],
        velocity_mps=whole.velocity_mps[indices],
        rotation_wxyz=whole.rotation_wxyz[indices],
    )


def craters_to_remove(manifest: Dataset, plan: Plan, per_scene: int, seed: int) -> pd.DataFrame:
    """At most `per_scene` craters to remove from each scene of a plan, with REMOVED_COLUMNS.

    Each crater has a label in the selection `visible` in at least one planned frame of the manifest. The random draw by
    `seed` takes about equal numbers from each class: three classes of diameter per scene, each with two classes of
    depth over diameter. The areas that two removals change do not overlap, so there may be fewer craters. Craters of an
    elevation model are never removed. Raises UserError if the manifest has no labels.
    """
    removed = [pd.DataFrame({name: pd.Series(dtype=kind) for name, kind in REMOVED_COLUMNS.items()})]
    if per_scene > 0:
        candidates = _candidates(manifest, plan)
        for scene in plan.scenes:
            in_scene = candidates[candidates["scene_id"] == scene.scene_id].assign(seed=scene.seed)
            rows = choose_apart(in_scene, per_scene, stream(seed, "counterfactual", scene.seed))
            removed.append(in_scene.iloc[np.sort(rows)][list(REMOVED_COLUMNS)])
    return pd.concat(removed[1:] or removed, ignore_index=True).astype(REMOVED_COLUMNS)


def _candidates(manifest: Dataset, plan: Plan) -> pd.DataFrame:
    """The generated craters that are visible in planned frames, in the order of their ids."""
    labels = read_labels(manifest)
    if not len(labels):
        expected = "a rendered dataset or its manifest, or --craters-per-scene 0"
        raise UserError(manifest.store, "labels", "no labels, as in a plan", expected)
    planned = {each.frame_id(index) for each in plan.trajectories for index in range(len(each.splits))}
    labels = labels[selected(labels, SELECTIONS["visible"]) & labels["frame_id"].isin(planned)]
    keys = ["scene_id", "crater_id"]
    seen = labels.groupby(keys).agg(
        diameter_m=("diameter_m", "first"), depth_m=("depth_m", "first"), n_frames=("frame_id", "size")
    )
    craters = manifest.table("craters", list(_CRATER))
    craters = craters.filter(pc.is_in(craters["scene_id"], pa.array([scene.scene_id for scene in plan.scenes])))
    rows = seen.reset_index().merge(craters.to_pandas(), on=keys, validate="one_to_one")
    rows = rows[rows["origin"] != "elevation model"].sort_values(keys)
    radius_m = rows["diameter_m"] / 2
    wear = diffusivity_m2_per_myr(rows["diameter_m"].to_numpy()) * rows["age_myr"] / radius_m**2
    # Only the largest fresh craters of a scene have rays; which craters these are is known only once the ground is
    # generated.
    may_have_rays = (wear < RAYED_WEAR) & (rows["origin"] == "primary")
    reach_m = np.where(may_have_rays, RAYS_REACH, REACH_RADII) * radius_m
    return rows.assign(depth_ratio=rows["depth_m"] / rows["diameter_m"], reach_m=reach_m)


def choose_apart(candidates: pd.DataFrame, n: int, rng: np.random.Generator) -> list[int]:
    """Row numbers of at most `n` candidates, drawn from each class in turn.

    The circles with radius reach_m around the chosen craters do not overlap.

    Needs the columns x_m, y_m, reach_m, diameter_m and depth_ratio.
    """
    classes = _classes(candidates["diameter_m"].to_numpy(), candidates["depth_ratio"].to_numpy())
    waiting = [
        rng.permutation(np.flatnonzero(classes == each)).tolist() for each in rng.permutation(np.unique(classes))
    ]
    x, y, reach = (candidates[name].to_numpy() for name in ("x_m", "y_m", "reach_m"))
    chosen: list[int] = []
    while any(waiting) and len(chosen) < n:
        for group in waiting:
            while group and len(chosen) < n:
                k = group.pop()
                if (np.hypot(x[chosen] - x[k], y[chosen] - y[k]) >= reach[chosen] + reach[k]).all():
                    chosen.append(k)
                    break
    return chosen


def _classes(diameter_m: np.ndarray, depth_ratio: np.ndarray) -> np.ndarray:
    """Class (N,) of each crater, by diameter and then by depth ratio, with equal numbers in each class."""
    classes = _N_DEPTHS * _ranked(diameter_m, _N_SIZES)
    for size in np.unique(classes):
        in_class = classes == size
        classes[in_class] += _ranked(depth_ratio[in_class], _N_DEPTHS)
    return classes


def _ranked(values: np.ndarray, n: int) -> np.ndarray:
    """Index (N,) of the n-quantile that holds each value."""
    rank = np.empty(len(values), int)
    rank[np.argsort(values, kind="stable")] = np.arange(len(values))
    return rank * n // max(len(values), 1)
