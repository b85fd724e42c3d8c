"""Rims and detection over ground of another generator, terraingenpy (BSD-3; `pip install terraingenpy`).

Its crater list has the diameters at formation; diffusion moves the crests of worn craters outwards. The benchmark
writes its height map as an elevation model and its list as a catalogue, reads both as `--dem` and `--catalogue` do, and
compares the measured rims with the place at which the mean profile of the height map itself, about the listed centre,
is highest. Then it renders frames over this ground and scores the installed detector, with labels of the listed rims
and of the measured ones. Writes runs/bench/other_ground.json, and pictures into runs/bench/other_ground/.

    python -m benchmarks.scene.other_ground --seeds 5
"""

import json
import tempfile
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.figures import write_figures
from benchmarks.scene.other_ground_detector import render, score
from perilune_render.config.terrain import TerrainConfig
from perilune_render.terrain.elevation.catalogue import RealCraters, read_catalogue
from perilune_render.terrain.elevation.model import read_elevation
from perilune_render.terrain.grid import Grid
from perilune_shared.console.command_line import one_command, run_command_line
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array, selenographic_from_site

PIXEL_M, SIDE_PX = 2.0, 2048
_WORN_GYR = 1.0
"""Age from which a crater counts as worn."""
_CLEAR_DEPTH = 0.04
"""Depth of the mean profile, in diameters, from which a crater takes part in the comparison."""


def bench(seeds: Annotated[int, typer.Option(help="Number of different grounds.", min=1)] = 5) -> None:
    """Compare rims over ground of terraingenpy with an independent measurement, and score the installed detector."""
    with tempfile.TemporaryDirectory() as folder:
        grounds = {f"other-ground-{seed}": Path(folder) / str(seed) for seed in range(1, seeds + 1)}
        rims = _compare_rims(list(grounds.values()))
        for name, ground in grounds.items():
            render(ground, name)
        detector = score(grounds, Path("runs/bench/other_ground"))
    write_figures(Path("runs/bench/other_ground.json"), {"rims": rims, "detector": detector})


def _compare_rims(folders: list[Path]) -> dict[str, Any]:
    """Write one ground into each folder, and compare its rims with its crests."""
    ratios: dict[str, list[float]] = {"measured": [], "listed": []}
    growth: dict[str, list[float]] = {"fresh": [], "worn": []}
    n_used = n_measured = n_compared = 0
    for seed, folder in enumerate(folders, 1):
        height, craters = _ground(seed)
        found = _read(folder, height, craters)
        own = found.craters
        n_used, n_measured = n_used + found.counts.used, n_measured + found.counts.measured
        for place in np.flatnonzero(np.isfinite(own.rim_rms_share)):
            away = np.hypot(craters[:, 0] - own.x_m[place], craters[:, 1] - own.y_m[place])
            listed = own.listed_diameter_m[place]
            nearest = np.where(np.abs(craters[:, 2] - listed) < 0.01, away, np.inf).argmin()
            x, y, _, age = craters[nearest]
            crest = _crest_m(height, x, y, listed / 2)
            if crest is None:
                continue
            n_compared += 1
            ratios["measured"].append(own.diameter_m[place] / 2 / crest)
            ratios["listed"].append(listed / 2 / crest)
            growth["worn" if age >= _WORN_GYR else "fresh"].append(2 * crest / listed)
    figures: dict[str, Any] = {"n_used": n_used, "n_measured": n_measured, "n_compared": n_compared}
    for name, values in ratios.items():
        figures[f"{name}_ratio_median"] = float(np.median(values))
        figures[f"{name}_ratio_p05"], figures[f"{name}_ratio_p95"] = map(float, np.percentile(values, [5, 95]))
    for name, values in growth.items():
        if values:
            figures[f"{name}_crest_over_listed_median"] = float(np.median(values))
    return figures


def _ground(seed: int) -> tuple[Array, Array]:
    """A height map (rows, columns) from the north, metres, and x west, y south, diameter, age in Gyr of its craters."""
    try:
        import terraingen  # type: ignore[import-not-found]
    except ImportError:
        raise UserError("terraingen", "package", "none", "the package: pip install terraingenpy") from None
    extent = {"center": [0, 0], "size": [PIXEL_M * SIDE_PX] * 2}
    age, law = {"age_gyr": 3.5}, {"production": "extended_neukum", "chronology": "neukum"}
    density = [{"type": "production_surface", **law, **age}, {"type": "trask"}]
    craters = {
        "type": "craters",
        "seed": seed,
        "density": {"type": "minimum", "distributions": density},
        "ages": {"type": "steady_state", **age, **law, "equilibrium": "trask"},
        "degradation": {"type": "diffusion", "diffusivity": "matched"},
        "profile": {"type": "martin_parkes_dunstan"},
        "min_diameter_m": 20,
        "max_diameter_m": 600,
    }
    noise = {"type": "noise", "stack": [{"seed": seed, "wavelength": 1500, "amplitude": 15, "octaves": 6}]}
    names = {"heightmap": "ground.tif", "crater_list": "list.csv"}
    outputs = [
        {"type": kind, "path": path, "pixel_size_m": PIXEL_M, "extent_m": extent} for kind, path in names.items()
    ]
    config = {"schema_version": 1, "layers": [noise, craters], "outputs": outputs}
    grid = terraingen.generate_from_config(terraingen.parse_config(json.dumps(config))).grid()
    table = grid.craters.table
    columns = -table["x"], -table["y"], table["diameter"], table["age_gyr"]
    return np.asarray(grid.heights.values, np.float64), np.column_stack(columns).astype(np.float64)


def _read(folder: Path, height_m: Array, craters: Array) -> RealCraters:
    """Write a height map and its craters as a user has them, and read them."""
    import rasterio

    half, crs = PIXEL_M * SIDE_PX / 2, "+proj=aeqd +lat_0=-20 +lon_0=-20 +R=1737400 +units=m"
    folder.mkdir()
    path = folder / "ground.tif"
    options = {"driver": "GTiff", "count": 1, "dtype": "float32", "crs": crs, "width": SIDE_PX, "height": SIDE_PX}
    transform = rasterio.Affine(PIXEL_M, 0, -half, 0, -PIXEL_M, half)
    with rasterio.open(path, "w", transform=transform, **options) as file:
        file.write(height_m.astype(np.float32), 1)
    latitude, longitude = selenographic_from_site(craters[:, 0], craters[:, 1], -20.0, -20.0)
    table = np.column_stack([longitude, latitude, craters[:, 2] / 1000])
    np.savetxt(folder / "list.csv", table, "%.9f", ",", header="Lon,Lat,Diam_km", comments="")
    return read_catalogue(folder / "list.csv", read_elevation(path), Grid.even(2 * half, 90), TerrainConfig())


def _crest_m(height_m: Array, x_m: float, y_m: float, radius_m: float) -> float | None:
    """Radius at which the mean over pixels at equal distance from a listed centre is highest; None if not clear."""
    reach_m, half_m = 2.2 * radius_m, PIXEL_M * SIDE_PX / 2
    if np.abs([x_m, y_m]).max() + reach_m > half_m:
        return None
    west = half_m - (np.arange(SIDE_PX) + 0.5) * PIXEL_M
    columns, rows = np.abs(west - x_m) < reach_m, np.abs(-west - y_m) < reach_m
    height_m = height_m[np.ix_(rows, columns)]
    distance = np.hypot(west[columns] - x_m, (-west[rows] - y_m)[:, None])
    near = distance < reach_m
    step = max(PIXEL_M / 2, radius_m / 20)
    bins = (distance[near] / step).astype(int)
    count = np.bincount(bins)
    mean = np.bincount(bins, height_m[near]) / np.maximum(count, 1)
    centre = np.bincount(bins, distance[near]) / np.maximum(count, 1)
    search = (centre > 0.6 * radius_m) & (centre < 1.9 * radius_m) & (count > 0)
    top = np.flatnonzero(search)[mean[search].argmax()]
    inner = np.flatnonzero(search)
    clear = mean[top] - mean[0] > 2 * _CLEAR_DEPTH * radius_m and top not in (inner[0], inner[-1])
    return float(centre[top]) if clear else None


if __name__ == "__main__":
    run_command_line(one_command(bench))
