"""The presets."""

import pytest
from pydantic import ValidationError

from perilune_shared.config.resolve import PRESETS, SECTIONS, resolve
from perilune_train.cli import main
from perilune_train.detect.config import DetectConfig


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_resolves(preset):
    config = resolve(DetectConfig, "detect", "perilune_train", preset)
    paper = preset in ("paper", "large")
    assert config.width == (1.0 if paper else config.width)
    assert config.strides == ((8, 16, 32) if paper else (4, 8, 16))
    assert config.attention != "none"


def test_the_papers_weights_and_limits_are_the_defaults():
    config = DetectConfig()
    assert (config.loss.lambda_iou, config.loss.lambda_obj, config.loss.aspect) == (0.05, 1.0, "circular")
    # Open at the top: the dataset's own bound counts, 50 px in the preset `paper`.
    assert config.labels.radius_px == (2.0, None)
    assert config.evaluation.match_iou == 0.5


def test_frozen_epochs_must_leave_some_to_train():
    with pytest.raises(ValidationError, match="frozen_epochs below epochs"):
        DetectConfig(epochs=3, frozen_epochs=3)


def test_every_section_of_the_trainer_is_known_to_configuration_files():
    assert set(main.SECTIONS) <= set(SECTIONS)
