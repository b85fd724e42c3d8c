"""Settings without measure: refused in one line that says what to lower, before memory is taken."""

from pathlib import Path

import pytest

import perilune_render.engines.blender.renderer
import perilune_render.jobs.local
import perilune_render.terrain.scene
from perilune_render.cli.main import main as render
from perilune_train.cli.main import main as train
from perilune_train.detect.train import detect_run as detect_training
from perilune_train.motion.train import navigate_run as navigate_training
from tests.helpers.drawn_dataset import build_dataset
from tests.hostile.measured import refused

# The commands import these only when they need them; imports would count as memory.
IMPORTED = (perilune_render, detect_training, navigate_training)

RENDER = {
    "dataset.terrain.boulders.density=1e9": "at most 1000",
    "dataset.terrain.boulders.field_density=1e12": "at most 100000",
    "dataset.terrain.craters.equilibrium_share=1e9": "0 to 100",
    "dataset.terrain.craters.max_diameter_m=1e300": "at most 100000",
    "dataset.terrain.relief.longest_wavelength_m=1e300": "at most",
    "dataset.terrain.max_vertices=1000000000000": "at most 40000000",
    "dataset.sensor.psf_sigma_px=1000000": "at most 50",
    "dataset.sensor.exposure_time_s=1e300": "at most 100",
    "dataset.sensor.exposure_time_s=.inf": "a finite number",
    "dataset.sensor.exposure_time_s=.nan": "a finite number",
    "dataset.sensor.full_well_e=1e300": "at most",
    "dataset.sensor.blur_poses=1000000": "at most 256",
    "dataset.camera.width_px=1000000": "at most 4096",
    "dataset.camera.focal_length_px=1e300": "at most",
    "dataset.camera.distortion.k1=1e300": "at most",
    "dataset.render.samples=1000000000": "at most 4096",
    "dataset.detect.n_scenes=1000000000": "at most 1000000",
    "dataset.detect.n_frames=1000000000": "at most 1000000",
    "dataset.detect.n_scenes=1000000": "n_scenes x trajectories_per_scene, which is 1000000, at most 200000: lower one",
    "dataset.detect.flight.start_altitude_m=1e300": "at most 500000",
    "dataset.detect.flight.duration_s=1e300": "at most 100000",
    "dataset.detect.sun.azimuth_deg=1e300": "-720 to 720",
    "dataset.seed=1e300": "an integer",
    "dataset.detect.n_scenes=" + "9" * 5000: "text that is not YAML",
}


@pytest.mark.parametrize("setting", RENDER, ids=lambda setting: setting[:60])
def test_rendering(setting: str, tmp_path: Path) -> None:
    arguments = ("dataset", "--preset", "tiny", "--kind", "detect", "--out", tmp_path / "out", "--set", setting)
    refused(setting[:60], render, *arguments, naming=RENDER[setting], memory_mb=200)
    assert not (tmp_path / "out").exists()


COSTS = {
    ("dataset.terrain.boulders.density=1000", "dataset.terrain.boulders.min_diameter_spacings=0.3"): "lower density",
    ("dataset.terrain.craters.equilibrium_share=100", "dataset.terrain.craters.min_diameter_spacings=1.5"): "number",
    ("dataset.terrain.spacing_px=1e-9",): "raise dataset.terrain.spacing_px or the lowest altitude",
    ("dataset.terrain.spacing_px=0.02",): "vertices",
    ("dataset.detect.flight.end_altitude_m=1e-300",): "raise dataset.terrain.spacing_px or the lowest altitude",
    ("dataset.detect.instruments.inertial_grades=[tactical]", "dataset.detect.instruments.inertial_rate_hz=1000",
     "dataset.detect.flight.duration_s=100000"): "measurements of one instrument",
}  # fmt: skip


@pytest.mark.parametrize("settings", COSTS, ids=lambda settings: settings[0])
def test_costs_are_computed_before_the_ground_is_made(settings: tuple[str, ...], tmp_path: Path) -> None:
    sets = [part for setting in settings for part in ("--set", setting)]
    arguments = ("dataset", "--preset", "small", "--kind", "detect", "--out", tmp_path / "out", *sets)
    refused(settings[0], render, *arguments, naming=COSTS[settings], memory_mb=300)


TRAIN = {
    "detect train": {
        "detect.batch_size=1000000000": "at most 65536",
        "detect.width=1e9": "at most 2",
        "detect.learning_rate=1e300": "at most 1000",
        "detect.seed=100000000000": "below 4294967296",
        "detect.epochs=1000000000000": "at most 1000000",
        "detect.evaluation.max_detections=1000000000": "at most 100000",
        "detect.devices=1000000": "at most 1024",
        "detect.workers=1000000": "at most 64",
    },
    "navigate train": {
        "navigate.warp.hidden=1000000000": "at most 4096",
        "navigate.stack.width=1e6": "at most 2",
        "navigate.warp.sequence_pairs=1000000000": "at most 4096",
        "navigate.warp.learning_rate=1e300": "at most 1000",
    },
    "explain": {
        "explain.n_frames=1000000000": "at most 100000",
        "explain.integration_steps=1000000000": "at most 10000",
        "explain.ring_factors=[1.1, 1.2, 1.3, 1e300]": "at most 100",
    },
}


@pytest.mark.parametrize(
    ("command", "setting"), [(command, setting) for command, settings in TRAIN.items() for setting in settings]
)
def test_training(command: str, setting: str, tmp_path: Path) -> None:
    arguments = (*command.split(), "--preset", "tiny", "--runs", tmp_path / "runs", "--set", setting)
    refused(setting, train, *arguments, naming=TRAIN[command][setting], memory_mb=200)
    assert not (tmp_path / "runs").exists()


def test_a_training_that_explodes_ends(tmp_path: Path) -> None:
    dataset = build_dataset(tmp_path / "detect-data", "detect")
    settings = ("width=0.125", "precision=float32", "device=cpu", "epochs=2", "warmup_steps=2", "learning_rate=1000")
    sets = [part for setting in settings for part in ("--set", f"detect.{setting}")]
    data = ("--preset", "tiny", "--dataset", dataset, "--runs", tmp_path, "--name", "a")
    refused(
        "a rate of 1000", train, "detect", "train", *data, *sets, naming="lower detect.learning_rate", memory_mb=3000
    )
    assert not (tmp_path / "detect" / "a" / "metrics.json").exists()
