"""Measure the harm of removing the pixels that a map attends to, compared with controls and with a perfect mask."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from perilune_train.explain.evidence.significance import unit_sign_flip_p
from perilune_train.records.spread import Array, Interval, Resamples, draw_resamples, spreads

Which = Literal["most", "least"]
Filling = Literal["inpaint", "mean"]
Measure = Callable[[NDArray[np.uint8]], NDArray[np.floating]]
"""Function that returns a value (N,) for each image (N, height, width); NaN if undefined."""
CONTROLS = ("random", "shifted")
"""Names of the controls (`random_like`, `shifted_like`)."""
PERFECT = "craters"
"""Name of the perfect mask: 1 in the ellipses of the selected craters, 0 elsewhere."""
_FILLINGS: tuple[Filling, ...] = ("inpaint", "mean")
BLOCK_PX = 8
"""Side of the removed blocks, pixels. Inpainting can restore single pixels, but not blocks of this size."""
_BINS = 10
_INPAINT_RADIUS_PX = 3
_WINDOW_PX = 31


def chosen_pixels(
    map_: NDArray[np.floating],
    share: float,
    which: Which,
    sign: int,
    rng: np.random.Generator,
    block_px: int = BLOCK_PX,
) -> NDArray[np.bool_]:
    """Pixels (height, width) of the blocks with the largest ("most") or smallest ("least") means of sign * map.

    The number of blocks is `share` times the number of all blocks, rounded. Equal means, which occur where a gate is at
    its bound, are ordered at random.
    """
    means = sign * block_means(map_, block_px).ravel()
    order = np.lexsort((rng.random(means.size), -means if which == "most" else means))
    return _pixels(order[: round(share * means.size)], map_.shape, block_px)


def random_like(
    image: NDArray[np.uint8], chosen: NDArray[np.bool_], rng: np.random.Generator, block_px: int = BLOCK_PX
) -> NDArray[np.bool_]:
    """Random blocks of an image (height, width) with the brightness distribution of the chosen blocks.

    From each decile of the image's block means, as many blocks are drawn as `chosen` contains. Chosen blocks may be
    drawn again, so that the control depends only on brightness. This makes the control harder to beat.
    """
    means = block_means(image, block_px).ravel()
    decile = np.empty(means.size, int)
    decile[np.lexsort((rng.random(means.size), means))] = np.arange(means.size) * _BINS // means.size
    taken = block_means(chosen, block_px).ravel() > 0.5
    drawn = [
        rng.choice(np.flatnonzero(decile == number), int((taken & (decile == number)).sum()), replace=False)
        for number in range(_BINS)
    ]
    return _pixels(np.concatenate(drawn), image.shape, block_px)


def shifted_like(chosen: NDArray[np.bool_], rng: np.random.Generator, block_px: int = BLOCK_PX) -> NDArray[np.bool_]:
    """The chosen blocks at another position: flipped, rotated and circularly shifted at random.

    In images that are not square, the rotation is 0 or 180 degrees.
    """
    blocks = block_means(chosen, block_px) > 0.5
    height, width = blocks.shape
    turns = int(rng.integers(4)) if height == width else 2 * int(rng.integers(2))
    moved = np.rot90(blocks[:, ::-1] if rng.integers(2) else blocks, turns)
    moved = np.roll(moved, (int(rng.integers(height)), int(rng.integers(width))), axis=(0, 1))
    return _pixels(np.flatnonzero(moved), chosen.shape, block_px)


def removed(image: NDArray[np.uint8], chosen: NDArray[np.bool_], how: Filling) -> NDArray[np.uint8]:
    """The image (height, width) with the chosen pixels replaced.

    "inpaint" uses Telea's method (2004, doi 10.1080/10867651.2004.10487596) with a radius of 3 px. "mean" uses the mean
    of the pixels that are not chosen in a window of 31 px, or in the image if the window has no such pixels.
    """
    if not chosen.any() or chosen.all():
        raise ValueError(f"{int(chosen.sum())} of {chosen.size} pixels chosen, expected some but not all")
    if how == "inpaint":
        return np.asarray(cv2.inpaint(image, chosen.astype(np.uint8), _INPAINT_RADIUS_PX, cv2.INPAINT_TELEA), np.uint8)
    kept = (~chosen).astype(np.float64)
    total, count = (
        cv2.boxFilter(part, -1, (_WINDOW_PX, _WINDOW_PX), normalize=False, borderType=cv2.BORDER_CONSTANT)
        for part in (kept * image, kept)
    )
    mean = np.where(count > 0.5, total / np.maximum(count, 1), image[~chosen].mean())
    return np.where(chosen, np.rint(mean), image).astype(np.uint8)


def removal_effect(
    images: NDArray[np.uint8],
    maps: Mapping[str, NDArray[np.floating]],
    sign: Mapping[str, int],
    measure: Measure,
    rng: np.random.Generator,
    share: float = 0.2,
) -> pd.DataFrame:
    """Values of a measure before and after removal of a share of the pixels of images (N, height, width).

    `maps` are (N, height, width); `sign` is 1, or -1 for a map that is weaker on craters. `measure` runs once on the
    unchanged images, and once for each combination of map, which and how. Edge maps ("edge/...") have no controls and
    no "least", and the perfect mask has no "least", because no claim needs them. If an image is two frames stacked in
    height, replacements at the seam use pixels of both frames. Columns:

    - map
    - which: "most" or "least" attended pixels, or the control "random" or "shifted"
    - how: the filling, "inpaint" or "mean"
    - frame_index
    - overlap: share of the removed pixels that are among the most attended pixels
    - before, after: values of the measure
    """
    before = np.asarray(measure(images))
    tables = []
    for name, image_maps in maps.items():
        most = [chosen_pixels(image_map, share, "most", sign[name], rng) for image_map in image_maps]
        choices = {"most": most}
        if not name.startswith("edge/"):
            choices["random"] = [random_like(*pair, rng) for pair in zip(images, most, strict=True)]
            choices["shifted"] = [shifted_like(image_map, rng) for image_map in most]
            if name != PERFECT:
                choices["least"] = [chosen_pixels(one, share, "least", sign[name], rng) for one in image_maps]
        for which, chosen in choices.items():
            overlap = [
                (image_map & first).sum() / image_map.sum() for image_map, first in zip(chosen, most, strict=True)
            ]
            for how in _FILLINGS:
                changed = np.stack([removed(*pair, how) for pair in zip(images, chosen, strict=True)])
                values = {"overlap": overlap, "before": before, "after": measure(changed)}
                index = np.arange(len(images))
                tables.append(pd.DataFrame({"map": name, "which": which, "how": how, "frame_index": index, **values}))
    return pd.concat(tables, ignore_index=True)


def removal_summary(effects: pd.DataFrame, higher_is_better: bool) -> pd.DataFrame:
    """Mean harm of each removal, and its ratio to the harm of the stronger control, by map and filling.

    `effects` is the table of `removal_effect`. Harm is the mean over frames of before - after, or of after - before if
    lower values are better. Columns:

    - map, how
    - most, least, random, shifted: harms; NaN if no frame has a value, or if this removal was not measured
    - control: name of the control with the larger harm
    - ratio: harm of `most` divided by the harm of this control; NaN unless the control's harm is above 0
    - overlap: mean share of this control's pixels that are among the most attended pixels. If only the most attended
      pixels matter, the ratio is about 1 / overlap.
    """
    change = effects["before"] - effects["after"]
    harm = effects.assign(harm=change if higher_is_better else -change)
    # A pivot table would drop maps and removals that have no values.
    means = harm.groupby(["map", "how", "which"])["harm"].mean()
    table = effects[["map", "how"]].drop_duplicates(ignore_index=True)
    pairs = list(zip(table["map"], table["how"], strict=True))
    for which in ("most", "least", *CONTROLS):
        table[which] = [float(means.get((*pair, which), np.nan)) for pair in pairs]
    controls = table[list(CONTROLS)]
    table["control"] = controls.fillna(-np.inf).idxmax(axis=1)
    table["ratio"] = (table["most"] / controls.max(axis=1)).where(controls.max(axis=1) > 0)
    overlaps = effects.groupby(["map", "how", "which"])["overlap"].mean()
    chosen = zip(pairs, table["control"], strict=True)
    table["overlap"] = [float(overlaps.get((*pair, control), np.nan)) for pair, control in chosen]
    return table


@dataclass(frozen=True, slots=True)
class Relative:
    """Harm of removing what a gate attends to, relative to the harm of another removal."""

    value: float
    """The ratio; NaN if the other removal does no harm."""
    interval: Interval | None
    """95 % interval over scenes; None with fewer than five scenes."""
    p: float
    """One-sided p, by sign flips of scenes, that the gate's removal does more harm; NaN where it is not tested."""


def relative_harm(
    effects: pd.DataFrame, gate: str, how: Filling, higher_is_better: bool, rng: np.random.Generator
) -> dict[str, Relative]:
    """Harm of removing what a gate attends to, relative to the stronger control, to edges and to a perfect mask.

    `effects` is the table of `removal_effect` with the columns frame_id and scene_id; only the filling `how` is used.
    Frames without a value are left out. Keys of the result:

    - "control": harm of the gate / harm of its stronger control. p is the larger p of both controls.
    - the name of each other map: harm of the gate / harm of this map's most attended pixels
    - `PERFECT`: the gate's ratio to its control / the perfect mask's ratio to the perfect mask's control. A perfect
      mask attends to other pixels, so it has its own controls. p is not tested.
    - "perfect control": the perfect mask's ratio to its stronger control. p is not tested.
    """
    harm = effects["before"] - effects["after"] if higher_is_better else effects["after"] - effects["before"]
    rows = effects.assign(harm=harm, removed=effects["map"] + "\n" + effects["which"])[effects["how"] == how]
    table = rows.pivot(index=["scene_id", "frame_id"], columns="removed", values="harm").dropna()
    scenes, frames = (table.index.get_level_values(name).astype(str).tolist() for name in ("scene_id", "frame_id"))
    resamples = draw_resamples(scenes, [name.rpartition("/")[0] for name in frames], frames, rng)
    every = np.arange(len(table))
    others = [str(name) for name in dict.fromkeys(rows["map"]) if name not in (gate, PERFECT)]

    def ratios(drawn: Resamples) -> dict[str, Array]:
        def most(name: str) -> Array:
            return drawn.totals(every, table[f"{name}\nmost"].to_numpy(np.float64))

        def to_control(name: str) -> Array:
            controls = [drawn.totals(every, table[f"{name}\n{each}"].to_numpy(np.float64)) for each in CONTROLS]
            return _ratio(most(name), np.maximum(*controls))

        found = {"control": to_control(gate)} | {name: _ratio(most(gate), most(name)) for name in others}
        if PERFECT in set(rows["map"]):
            perfect = to_control(PERFECT)
            found |= {PERFECT: _ratio(found["control"], perfect), "perfect control": perfect}
        return found

    whole = ratios(replace(resamples, weights=np.ones((1, resamples.count))))
    intervals = spreads(ratios, every, resamples)
    differences = table[f"{gate}\nmost"].to_numpy()[:, None] - table.to_numpy()
    by_scene = pd.DataFrame(differences, table.index, table.columns).groupby(level="scene_id").mean()
    p = {name: unit_sign_flip_p(by_scene[f"{name}\nmost"].to_numpy(np.float64)) for name in others}
    p["control"] = max(unit_sign_flip_p(by_scene[f"{gate}\n{each}"].to_numpy(np.float64)) for each in CONTROLS)
    return {
        name: Relative(float(value[0]), intervals[name].interval, p.get(name, float("nan")))
        for name, value in whole.items()
    }


def _ratio(over: Array, under: Array) -> Array:
    """over / under; NaN where `under` is not above 0."""
    return np.where(under > 0, over / np.where(under > 0, under, 1.0), np.nan)


def block_means(values: NDArray, block_px: int) -> NDArray[np.float64]:
    """Means (rows, columns) of square blocks of values (height, width), from the upper left.

    Blocks at the right and lower edges are smaller if height or width is not a multiple of block_px.
    """
    sums, sizes = (_block_sums(array, block_px) for array in (values, np.ones(values.shape)))
    return sums / sizes


def _block_sums(values: NDArray, block_px: int) -> NDArray[np.float64]:
    rows, columns = (-(-side // block_px) for side in values.shape)
    padding = [(0, count * block_px - side) for count, side in zip((rows, columns), values.shape, strict=True)]
    blocks = np.pad(values, padding).reshape(rows, block_px, columns, block_px)
    return blocks.sum(axis=(1, 3), dtype=np.float64)


def _pixels(blocks: NDArray[np.integer], shape: tuple[int, ...], block_px: int) -> NDArray[np.bool_]:
    """Pixels (height, width) of the blocks with these numbers, counted row by row."""
    rows, columns = (-(-side // block_px) for side in shape)
    chosen = np.zeros((rows, columns), bool)
    chosen.flat[blocks] = True
    return chosen.repeat(block_px, axis=0).repeat(block_px, axis=1)[: shape[0], : shape[1]]
