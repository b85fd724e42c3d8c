"""The picture of a dataset card: frames with their labels, and histograms of the dataset.

Needs matplotlib: `pip install "perilune-shared[pictures]"`.
"""

import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import pyarrow as pa
from numpy.typing import NDArray

from perilune_shared.console.progress import Progress
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.names import SPLITS
from perilune_shared.dataset.schema import TABLES
from perilune_shared.errors import UserError
from perilune_shared.export.rows import SceneRows, by_selection, scenes_of
from perilune_shared.labels.thresholds import SELECTIONS
from perilune_shared.storage.png import png_header

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_N_FRAMES = 8
_COLUMNS = 4
_COLOURS = {"train": "#4477aa", "val": "#ee9933", "test": "#228855"}
_LOGARITHMIC = ("radius_px", "visible_fraction", "sunlit_fraction")
"""Measures with a logarithmic count axis, since most values are in few bins."""
_SELECTED_COLOUR, _OTHER_COLOUR = "#50dc50", "#ff8c3c"
TITLES = {
    "radius_px": "label radius sqrt(a b), px",
    "labels_per_frame": "labels per frame",
    "altitude_m": "altitude above the site, m",
    "sun_elevation_deg": "Sun's elevation, deg",
    "visible_fraction": "visible fraction of the rim",
    "sunlit_fraction": "sunlit fraction of the crater",
    "depth_ratio": "depth / diameter of labelled craters",
    "contrast": "contrast",
    "speed_mps": "speed, m/s",
    "real_ground_share": "share of real ground",
}
"""Axis title of each measure's histogram, in the order of the histograms."""


@dataclass(frozen=True, slots=True)
class Gathered:
    """Data that the card shows."""

    measures: dict[str, dict[str, NDArray[np.float32]]]
    """Values by measure and split; see `TITLES` for names and units."""
    samples: list[tuple[dict, pd.DataFrame]] = field(default_factory=list)
    """Frames to show: the row of each frame, and its labels. Their column `visible` states whether the selection
    `visible` contains the label."""


def gather(dataset: Dataset, progress: Progress) -> Gathered:
    """Collect the data of a card in one pass over the scenes. Raises UserError if there are no frames."""
    ids = dataset.scene_ids()
    if not ids:
        raise UserError(dataset.store, "scenes", "none", "a dataset with frames")
    task = progress.add_task("reading", total=len(ids), unit="scenes")
    collected: dict[str, dict[str, list[np.ndarray]]] = {}
    samples: list[tuple[dict, pd.DataFrame]] = []
    # Spread the frames over the scenes and along the trajectories.
    places = np.linspace(0, len(ids) - 1e-9, _N_FRAMES, endpoint=False).astype(int)
    shown_of_scene = {ids[place]: np.flatnonzero(places == place) for place in places}
    for scene in scenes_of(dataset, choose=by_selection(SELECTIONS["visible"])):
        ratio = _depth_ratios(dataset, scene)
        for split, frames in scene.frames.groupby("split"):
            of_frames = scene.labels["frame_id"].isin(frames["frame_id"]).to_numpy()
            for name, values in _measured(frames, scene.labels[of_frames], ratio[of_frames]).items():
                collected.setdefault(name, {}).setdefault(str(split), []).append(values.astype(np.float32))
        for k in shown_of_scene.get(scene.scene_id, ()):
            row = scene.frames.iloc[round(k / (_N_FRAMES - 1) * (len(scene.frames) - 1))]
            of_frames = (scene.labels["frame_id"] == row["frame_id"]).to_numpy()
            samples.append((row.to_dict(), scene.labels[of_frames].assign(visible=scene.labels["chosen"][of_frames])))
        progress.advance(task)
    measures = {name: {split: np.concatenate(v) for split, v in by.items()} for name, by in collected.items()}
    return Gathered({name: measures[name] for name in TITLES if name in measures}, samples)


def draw(dataset: Dataset, gathered: Gathered) -> bytes:
    """Return the picture as the bytes of a PNG.

    Raises UserError if matplotlib is missing or a frame does not match the manifest.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
        from matplotlib.patches import Patch
    except ImportError:
        raise UserError("card", "matplotlib", "not installed", 'pip install "perilune-shared[pictures]"') from None
    samples = gathered.samples if dataset.info.images in ("files", "packed") else []
    # Show at most two rows of histograms; omit the measures that do not fit.
    measures = dict(list(gathered.measures.items())[: 2 * _COLUMNS])
    n_sample_rows = -(-len(samples) // _COLUMNS)
    heights = [1.0] * n_sample_rows + [0.72] * -(-len(measures) // _COLUMNS)
    figure = Figure(figsize=(11.0, 2.8 * sum(heights)), dpi=80, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(heights), _COLUMNS, squeeze=False, height_ratios=heights)
    for axis in axes.ravel():
        axis.set_axis_off()
    frames = pa.Table.from_pylist([{name: row[name] for name in ("frame_id", "png_path")} for row, _ in samples])
    pngs = dict(dataset.pngs(frames)) if samples else {}
    for axis, (row, labels) in zip(axes.ravel(), samples, strict=False):
        _draw_frame(axis, row, labels, pngs[row["frame_id"]])
    for axis, (name, by_split) in zip(axes[n_sample_rows:].ravel(), measures.items(), strict=False):
        _draw_histogram(axis, name, by_split)
    present = [split for split in SPLITS if split in gathered.measures["altitude_m"]]
    keys = [Patch(color=_COLOURS[split], label=split) for split in present]
    axes[n_sample_rows, 0].legend(handles=keys, fontsize=7, frameon=False)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def _depth_ratios(dataset: Dataset, scene: SceneRows) -> NDArray[np.float64]:
    """Return depth / diameter (N,) of the crater of each label of a scene; NaN if a crater is missing."""
    columns = ["crater_id", "diameter_m", "depth_m"]
    craters = dataset.table("craters", columns, scene_id=scene.scene_id).to_pandas().drop_duplicates("crater_id")
    ratio = (craters["depth_m"] / craters["diameter_m"]).set_axis(craters["crater_id"])
    return ratio.reindex(scene.labels["crater_id"]).to_numpy(np.float64)


def _measured(frames: pd.DataFrame, labels: pd.DataFrame, depth_ratio: np.ndarray) -> dict[str, np.ndarray]:
    counted = labels.groupby("frame_id").size().reindex(frames["frame_id"], fill_value=0)
    sun = np.stack(frames["sun_direction"].to_list())
    measures = {
        "labels_per_frame": counted.to_numpy(),
        "altitude_m": np.stack(frames["position_m"].to_list())[:, 2],
        "sun_elevation_deg": np.degrees(np.arcsin(np.clip(sun[:, 2], -1, 1))),
        "depth_ratio": depth_ratio,
        "speed_mps": np.linalg.norm(np.stack(frames["velocity_mps"].to_list()), axis=1),
    }
    real = frames["real_ground_share"].to_numpy(np.float64)
    if np.nan_to_num(real).any():
        measures["real_ground_share"] = real
    names = [name for name in TITLES if name in TABLES["labels"].names]
    return measures | {name: labels[name].to_numpy(np.float64) for name in names}


def _draw_frame(axis: "Axes", row: dict, labels: pd.DataFrame, png: bytes) -> None:
    from matplotlib import image
    from matplotlib.collections import EllipseCollection

    width, height = row["width_px"], row["height_px"]
    try:
        # Check the header first: a small file may decompress to any size.
        header = png_header(png)
        if (header.width_px, header.height_px) != (width, height):
            raise ValueError(f"{header.width_px} x {header.height_px} px")
        grey = image.imread(io.BytesIO(png), format="png")
    except (ValueError, OSError, SyntaxError) as error:
        raise UserError(row["png_path"], "frame", error, f"a grey PNG of {width} x {height} px") from None
    axis.imshow(grey, cmap="gray", vmin=0, vmax=1, extent=(0, width, height, 0), interpolation="nearest")
    chosen = labels["visible"].to_numpy()
    ellipses = EllipseCollection(
        2 * labels["ellipse_a_px"].to_numpy(),
        2 * labels["ellipse_b_px"].to_numpy(),
        np.degrees(labels["ellipse_theta_rad"].to_numpy()),
        units="xy",
        offsets=labels[["ellipse_cx_px", "ellipse_cy_px"]].to_numpy(),
        offset_transform=axis.transData,
        facecolors="none",
        edgecolors=np.where(chosen, _SELECTED_COLOUR, _OTHER_COLOUR).tolist(),
        linewidths=1.1,
    )
    axis.add_collection(ellipses)
    axis.set_xlim(0, width)
    axis.set_ylim(height, 0)
    altitude_m = float(np.asarray(row["position_m"])[2])
    axis.set_title(f"{row['split']}, altitude {altitude_m:.0f} m, {len(labels)} labels", fontsize=8)


def _draw_histogram(axis: "Axes", name: str, by_split: Mapping[str, np.ndarray]) -> None:
    axis.set_axis_on()
    finite = {split: by_split[split][np.isfinite(by_split[split])] for split in SPLITS if split in by_split}
    all_values = np.concatenate(list(finite.values()))
    if not len(all_values):
        axis.text(0.5, 0.5, "no values", ha="center", va="center", transform=axis.transAxes, fontsize=8)
    else:
        low, high = float(all_values.min()), float(all_values.max())
        # Equal values would give bins of zero width.
        edges = (
            np.linspace(low, high, 31) if high - low > 1e-6 * max(1.0, abs(high)) else np.linspace(low - 1, low + 1, 4)
        )
        colours = [_COLOURS[split] for split in finite]
        logarithmic = name in _LOGARITHMIC
        # Stacked bars would mislead on a logarithmic axis: draw outlines instead.
        style = {"histtype": "step"} if logarithmic else {"stacked": True}
        axis.hist(list(finite.values()), edges.tolist(), log=logarithmic, color=colours, **style)
    axis.set_xlabel(TITLES[name], fontsize=8)
    axis.tick_params(labelsize=7)
    axis.spines[["top", "right"]].set_visible(False)
