"""Plan the scenes of the locked benchmark, as data_manifests/benchmark-*.

    python scripts/benchmark_manifests.py --elevation-models FOLDER --out data_manifests

The benchmark has nine scenes of highland and nine of mare ground, two scenes with another camera, and one scene on each
of two elevation models (NPB_1km.tif and NPC_2km.tif of the repository nasa-jpl/lunasynth), for detection and for
navigation. For detection, six more scenes are seen at 20 to 60 degrees from straight down. All frames are test frames.
Seeds depend on the dataset's name, and no preset has these names, so no preset renders these scenes.
"""

import subprocess
import sys
from pathlib import Path
from typing import Annotated

from perilune_shared.console.interrupts import end_at_interrupt

if __name__ == "__main__":
    # An import by another module must not change how Ctrl-C works.
    end_at_interrupt()

import typer

from perilune_shared.console.command_line import one_command, run_command_line

REGIONS = ("highland", "mare")
"""Regions, named as their files in configs/."""
SETTINGS_OF_KIND = {
    "detect": {"trajectories_per_scene": 2, "n_frames": 20, "flight.attitude_sigma_deg": 1.0},
    "nav": {"trajectories_per_scene": 1, "n_frames": 40},
}
"""Settings of each kind of dataset, under which each scene has 40 frames."""
SETTINGS_OF_ALL = {
    "split_by": "scene",
    "val_share": 0,
    "test_share": 1,
    "flight.azimuth_deg": "{low: 0, high: 360}",
    "sun.elevation_deg": "{low: 8, high: 65}",
}
OTHER_CAMERA = {
    "dataset.camera.horizontal_fov_deg": 35,
    "dataset.camera.distortion": "{k1: -0.12, k2: 0.03}",
    "dataset.sensor.read_noise_e": 40,
    "dataset.sensor.psf_sigma_px": 0.7,
}
"""A narrower field of view with a distorting lens and a noisier sensor."""
OBLIQUE = {
    "dataset.light.photometry": "hapke_mean",
    "dataset.terrain.spacing_px": 0.75,
    "dataset.terrain.relief.rms_slope_deg": "{low: 2, high: 7}",
    "dataset.terrain.craters.equilibrium_share": "{low: 0.9, high: 1.8}",
    "dataset.detect.trajectories_per_scene": 5,
    "dataset.detect.n_frames": 8,
    "dataset.detect.flight.off_nadir_deg": "{low: 20, high: 60}",
    "dataset.detect.flight.off_nadir_azimuth_deg": "{low: 0, high: 360}",
}
"""Tilted views of ground from mare to highland. Each trajectory has its own tilt, and five for each scene cover the
range. With the default spacing_px of 0.5, ground up to the horizon would have more than the 12 million vertices that
terrain.max_vertices allows."""
ELEVATION_MODELS = {"npb": "NPB_1km.tif", "npc": "NPC_2km.tif"}
"""File of each elevation model, by the end of the manifest's name."""


def plan(kind: str, part: str, n_scenes: int, out: Path, settings: dict[str, object], *options: str) -> None:
    """Plan one manifest with additional `settings`, given by their full names."""
    chosen = {
        "dataset.name": f"benchmark-{part}",
        f"dataset.{kind}.n_scenes": n_scenes,
        **{f"dataset.{kind}.{key}": value for key, value in (SETTINGS_OF_ALL | SETTINGS_OF_KIND[kind]).items()},
        **settings,
    }
    pairs = [text for key, value in chosen.items() for text in ("--set", f"{key}={value}")]
    program, folder = Path(sys.executable).with_name("perilune-render"), out / f"benchmark-{kind}-{part}"
    command = [program, "plan", "--preset", "large", "--kind", kind, *options, *pairs, "--out", folder]
    # In a process group of its own, so that at Ctrl-C only this program prints a line.
    subprocess.run(list(map(str, command)), check=True, process_group=0)


def main(
    elevation_models: Annotated[Path, typer.Option(help="Folder with the two GeoTIFF files.")],
    out: Annotated[Path, typer.Option(help="Folder of the manifests.")],
) -> None:
    """Write eleven manifests."""
    for kind in SETTINGS_OF_KIND:
        for region in REGIONS:
            plan(kind, region, 9, out, {}, "--config", f"configs/{region}.yaml")
        plan(kind, "camera", 2, out, OTHER_CAMERA)
        for part, file in ELEVATION_MODELS.items():
            plan(kind, part, 1, out, {}, "--dem", str(elevation_models / file))
    plan("detect", "oblique", 6, out, OBLIQUE)


if __name__ == "__main__":
    run_command_line(one_command(main))
