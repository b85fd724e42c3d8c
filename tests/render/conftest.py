"""A small scene that tests share."""

import pytest
from tests.helpers.scenes import config_with

from perilune_render.config.dataset import DatasetConfig
from perilune_render.config.terrain import BouldersConfig, TerrainConfig
from perilune_render.flight.view import view_envelope
from perilune_render.terrain.scene import Scene, grow_scene
from perilune_shared.geometry.camera import Camera


@pytest.fixture(scope="session")
def camera() -> Camera:
    return Camera.from_field_of_view(128, 128, 50.0)


@pytest.fixture(scope="session")
def small_config() -> DatasetConfig:
    return config_with(terrain=TerrainConfig(spacing_px=1.0, boulders=BouldersConfig(density=0.0)))


@pytest.fixture(scope="session")
def scene(small_config, camera) -> Scene:
    return grow_scene(small_config, view_envelope(camera, small_config.detect.flight), 3)
