"""Draw docs/pictures/hazard.jpg: a frame, its scene's hazard map, and its flash lidar image.

python scripts/draw_hazard.py data/hazard/nav scene-0000/trajectory-0000/000004
"""

from pathlib import Path
from typing import Annotated

from perilune_shared.console.interrupts import end_at_interrupt

if __name__ == "__main__":
    # An import by another module must not change how Ctrl-C works.
    end_at_interrupt()

import cv2
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import rasterio
import typer

from perilune_render.imaging.exr import read_exr
from perilune_shared.console.command_line import one_command, run_command_line
from perilune_shared.dataset.manifest import open_dataset


def main(
    folder: Annotated[Path, typer.Argument(help="Dataset with hazard maps and flash lidar.", show_default=False)],
    frame_id: Annotated[str, typer.Argument(help="Frame of the dataset.", show_default=False)],
) -> None:
    """Write docs/pictures/hazard.jpg from a frame of a dataset with hazard maps and flash lidar."""
    dataset = open_dataset(folder)
    row = next(row for row in dataset.table("frames").to_pylist() if row["frame_id"] == frame_id)
    scene = next(row_of for row_of in dataset.table("scenes").to_pylist() if row_of["scene_id"] == row["scene_id"])
    with rasterio.open(dataset.file(scene["hazard_path"])) as raster:
        layers = dict(zip(raster.descriptions, raster.read(), strict=True))
        bounds = raster.bounds
    image = cv2.imread(str(dataset.file(row["png_path"])), cv2.IMREAD_UNCHANGED)
    lidar = read_exr(dataset.file(row["lidar_path"]))["range"]
    # The camera's x axis points west; turn the picture by 180 degrees, so that north is up as in the map.
    image, lidar = image[::-1, ::-1], lidar[::-1, ::-1]
    figure, axes = plt.subplots(1, 6, figsize=(24, 4.2), layout="constrained")
    height_m = row["position_m"][2]
    axes[0].imshow(image, cmap="gray")
    axes[0].set_title(f"frame, {height_m:.0f} m above the site")
    shown = axes[1].imshow(np.ma.masked_invalid(lidar), cmap="cividis")
    axes[1].set_title("flash lidar, range, m")
    figure.colorbar(shown, ax=axes[1], shrink=0.8)
    for ax in axes[:2]:
        ax.set_xticks([])
        ax.set_yticks([])
    extent = (bounds.left, bounds.right, bounds.bottom, bounds.top)
    panels = {"slope": ("deg", "viridis"), "roughness": ("m", "magma"), "shadow": ("share", "gray_r")}
    for ax, (name, (unit, colours)) in zip(axes[2:], (*panels.items(), ("safe", ("1 or 0", "RdYlGn"))), strict=True):
        most = 1.0 if name in ("shadow", "safe") else float(np.percentile(layers[name], 99.5))
        shown = ax.imshow(layers[name], extent=extent, cmap=colours, vmin=0, vmax=most, interpolation="nearest")
        ax.set_title(f"{name}, {unit}")
        ax.set_xlabel("east, m")
        figure.colorbar(shown, ax=ax, shrink=0.8)
    axes[2].set_ylabel("north, m")
    figure.savefig(Path(__file__).parent.parent / "docs/pictures/hazard.jpg", dpi=65, pil_kwargs={"quality": 86})


if __name__ == "__main__":
    run_command_line(one_command(main))
