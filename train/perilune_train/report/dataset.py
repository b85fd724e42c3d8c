"""The report's section on a dataset: counts, histograms, a shaded map and labelled frames."""

from collections.abc import Mapping

import numpy as np
import pyarrow.compute as pc
from matplotlib.axes import Axes
from numpy.typing import NDArray

from perilune_shared.dataset.manifest import Dataset
from perilune_train.detect.data.split import DetectSplit
from perilune_train.report.content import Figure, FramePicture, Section, Table
from perilune_train.report.frames import LabelledFrames, labelled_frames
from perilune_train.report.ground import scene_map
from perilune_train.report.pictures import COLOURS, DASHES, drawing, label_axes, logarithmic, svg_of
from perilune_train.report.sources import provenance_of_dataset

Array = NDArray[np.float64]
_SPLITS = ("train", "val", "test")
_HATCHES = ("", "///", "...")
_LABELLED = 4


def dataset_section(dataset: Dataset, key: str, split: DetectSplit | None) -> Section:
    """The section on a dataset. `split` has the test frames with labels; None if the dataset has no labels."""
    info, provenance = dataset.info, provenance_of_dataset(dataset)
    counts = {name: value for name, value in info.counts.model_dump().items() if value}
    table = Table(
        "Number of rows",
        ("", *counts),
        (("rows", *(f"{value:,}" for value in counts.values())),),
        (provenance,),
    )
    camera = info.camera
    scenes = "1 scene" if info.counts.scenes == 1 else f"{info.counts.scenes} scenes"
    lead = (
        f"{info.name}: {info.counts.frames:,} frames of {camera.width_px} x {camera.height_px} pixels over {scenes}, "
        f"split by {info.split_by}{info.leak}.",
    )
    pictures: tuple[FramePicture, ...] = ()
    if split is not None:
        pictures = tuple(labelled_pictures(labelled_frames(split, None, provenance)))
    return Section(key, _title(dataset), lead, (table,), (*_histograms(dataset), _map(dataset)), pictures)


def _title(dataset: Dataset) -> str:
    return "Dataset for detection" if dataset.info.kind == "detect" else "Dataset for navigation"


def labelled_pictures(frames: LabelledFrames) -> list[FramePicture]:
    """Four frames of the test split, from the highest to the lowest, from different trajectories if possible."""
    altitude = np.array([position[2] for position in frames.split.frames.table["position_m"]])
    trajectory = frames.split.frames.table["trajectory_id"].to_numpy()
    scene = frames.split.frames.table["scene_id"].to_numpy()
    names = list(dict.fromkeys(zip(scene.tolist(), trajectory.tolist(), strict=True)))
    chosen = []
    for number, target in enumerate(np.linspace(altitude.max(), altitude.min(), _LABELLED)):
        rows = np.flatnonzero([pair == names[number % len(names)] for pair in zip(scene, trajectory, strict=True)])
        chosen.append(int(rows[np.argmin(np.abs(altitude[rows] - target))]))
    return [frames.picture(index) for index in dict.fromkeys(chosen)]


def _map(dataset: Dataset) -> Figure:
    rows = dataset.table("frames", ["scene_id", "split"])
    tested = rows.filter(pc.equal(rows["split"], "test"))
    scenes = (tested if len(tested) else rows)["scene_id"].unique().to_pylist()
    return scene_map(dataset, min(scenes))


def _histograms(dataset: Dataset) -> list[Figure]:
    rows = dataset.table("frames", ["split", "position_m", "sun_direction"])
    split = np.array(rows["split"].to_pylist())
    position, sun = (_vectors(rows[name].to_pylist()) for name in ("position_m", "sun_direction"))
    sun_deg = np.degrees(np.arcsin(np.clip(sun[:, 2] / np.linalg.norm(sun, axis=1), -1, 1)))
    panels = [("Altitude of the frames", "altitude (m)", "frames", position[:, 2], split)]
    panels.append(("Sun above the horizon", "Sun elevation (degrees)", "frames", sun_deg, split))
    labels = dataset.table("labels", ["split", "radius_px"])
    if len(labels):
        radius = labels["radius_px"].to_numpy().astype(np.float64)
        panels.append(("Labelled radii", "radius (px)", "labels", radius, np.array(labels["split"].to_pylist())))
    diameter = dataset.table("craters", ["diameter_m"])["diameter_m"].to_numpy()
    if len(diameter):
        panels.append(("Craters of the ground", "diameter (m)", "craters", diameter, np.full(len(diameter), "")))
    figures = []
    for title, x, y, values, groups in panels:
        with drawing(height_in=3.2) as figure:
            axes = figure.subplots()
            names = [name for name in _SPLITS if np.any(groups == name)] or [""]
            _histogram(axes, {name: values[groups == name] for name in names}, on_logarithms=y != "frames")
            label_axes(axes, title, x, y)
            if names != [""]:
                figure.legend(loc="outside lower center", ncols=3)
            html = svg_of(figure, f"Histogram: {title}")
        by = " by split" if names != [""] else ""
        figures.append(Figure(html, f"{title}{by}.", (provenance_of_dataset(dataset),)))
    return figures


def _histogram(axes: Axes, values: Mapping[str, Array], *, on_logarithms: bool) -> None:
    """Draw a histogram of each group as stacked bars; on logarithmic axes as lines, because stacked bars mislead."""
    finite = {name: group[np.isfinite(group) & ((group > 0) | (not on_logarithms))] for name, group in values.items()}
    known = np.concatenate(list(finite.values()))
    low, high = (known.min(), known.max()) if len(known) else (1.0, 2.0)
    bins = np.geomspace(low, max(high, low * 1.01), 31) if on_logarithms else np.linspace(low, max(high, low + 1), 31)
    below = np.zeros(len(bins) - 1)
    for number, (name, group) in enumerate(finite.items()):
        counted, colour, label = np.histogram(group, bins)[0].astype(np.float64), COLOURS[number], name or None
        if on_logarithms:
            axes.stairs(counted, bins, color=colour, linestyle=DASHES[number], linewidth=1.7, label=label)
            continue
        style = {"color": colour, "hatch": _HATCHES[number], "edgecolor": "white", "linewidth": 0.3}
        axes.bar(bins[:-1], counted, np.diff(bins), below, align="edge", label=label, **style)
        below = below + counted
    if on_logarithms:
        logarithmic(axes, "x", "y")
        axes.set_ylim(bottom=0.7)


def _vectors(rows: list) -> Array:
    return np.array(rows, np.float64).reshape(-1, 3)
