from pathlib import Path

import numpy as np
import pytest
import rasterio
from tests.helpers.elevation_models import POLAR, write

from perilune_render.cli.options import resolved_config
from perilune_render.cli.sun import highest_sun_deg, warn_of_sun, warn_of_suns

TOP = Path(__file__).parents[3]


def test_the_highest_sun_of_a_latitude():
    assert [highest_sun_deg(latitude) for latitude in (0.0, 90.0, -84.8, 1.0)] == pytest.approx([90, 1.59, 6.79, 90])


def test_a_sun_too_high_for_the_stated_site(capsys):
    def warning(*settings: str) -> str:
        config = resolved_config("small", None, list(settings), None, None)
        warn_of_suns(config, ("detect", "nav"))
        return capsys.readouterr().err

    assert warning() == "", "procedural ground of no place"
    assert warning("dataset.terrain.latitude_deg=10") == ""
    assert warning("dataset.terrain.latitude_deg=-85").splitlines() == [
        f"warning: dataset.{kind}.sun.elevation_deg: got {high} degrees, expected at most 6.6: at 85.0 degrees south "
        "the Sun is never higher"
        for kind, high in (("detect", 65), ("nav", 60))
    ]


def test_the_site_of_an_elevation_model_counts(tmp_path, capsys):
    heights = np.add.outer(np.arange(100.0), np.arange(100.0))
    dem = write(tmp_path / "a.tif", heights, POLAR, rasterio.Affine(10, 0, 127_000, 0, -10, 0))
    config = resolved_config("tiny", None, None, dem, None)
    warn_of_sun(config, "here", 5.0)
    assert capsys.readouterr().err == ""
    warn_of_sun(config, "here", 6.0)
    assert "warning: here: got 6 degrees, expected at most 5.8: at 85.8 degrees south" in capsys.readouterr().err


def test_the_shared_configuration_of_the_pole_has_a_possible_sun():
    config = resolved_config("tiny", TOP / "configs/south_pole.yaml", None, None, None)
    assert config.detect.sun.elevation_deg.high <= highest_sun_deg(-84.8)
