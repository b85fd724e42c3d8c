import copy
import functools
import re

import pytest
from pydantic import ValidationError

from perilune_shared.config.resolve import SECTIONS, parse_setting, resolve, resolve_over, to_yaml
from perilune_shared.errors import UserError
from perilune_train.detect.config import DetectConfig
from perilune_train.explain.config import ExplainConfig
from perilune_train.motion.config import NavigateConfig

DatasetConfig = pytest.importorskip("perilune_render.config.dataset").DatasetConfig


def dataset(**kwargs):
    return resolve(DatasetConfig, "dataset", "perilune_render", "tiny", **kwargs)


def fault(**kwargs) -> str:
    with pytest.raises(UserError) as caught:
        dataset(**kwargs)
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_later_sources_override(tmp_path):
    file = tmp_path / "a.yaml"
    file.write_text("dataset: {seed: 5, terrain: {relief: {rms_slope_deg: 1}}}")
    config = dataset(config_file=file, settings=("dataset.seed=7", "dataset.camera.width_px=64"))
    assert config.seed == 7 and config.terrain.relief.rms_slope_deg.high == 1.0
    assert config.camera.width_px == 64 and config.camera.height_px == 128


def test_an_unknown_key_suggests_the_nearest(tmp_path):
    file = tmp_path / "a.yaml"
    file.write_text("dataset: {terrain: {craters: {max_diametre_m: 3}}}")
    text = fault(config_file=file)
    assert "a.yaml" in text and "dataset.terrain.craters.max_diametre_m" in text and "max_diameter_m" in text


@pytest.mark.parametrize(
    ("setting", "parts"),
    [
        ("dataset.camera.width_px=-4", ["--set", "dataset.camera.width_px", "-4", "at least 16"]),
        ("dataset.camera.width_px=wide", ["dataset.camera.width_px", "'wide'", "integer"]),
        ("dataset.seed=1.5", ["dataset.seed", "1.5"]),
        ("dataset.detect.split_by=crater", ["dataset.detect.split_by", "'scene'"]),
        ("dataset.detect.flight.end_altitude_m=2000", ["below start_altitude_m"]),
        ("dataset.seeed=1", ["an unknown key", "seed (nearest known)"]),
        ("datset.seed=1", ["an unknown section", "dataset (nearest known)"]),
        ("seed=1", ["section.key=value"]),
        ("dataset.seed", ["section.key=value"]),
        ("dataset.terrain.relief.rms_slope_deg=.inf", ["rms_slope_deg"]),
        ("dataset.terrain=flat", ["dataset.terrain", "got 'flat', expected a mapping"]),
        ("dataset.detect.sun.elevation_deg={low:5,high:9}", ["'low:5' without a value", "a space after the colon"]),
        ("dataset.detect.sun.elevation_deg=low:5", ["got 'low:5', expected a mapping, with a space after each colon"]),
        ("dataset.detect.flight.duration_s=1:30", ["got '1:30', expected a number"]),
        ("dataset.light.bounce=off", ["got 'off', expected true or false"]),
        ("dataset.camera={width_px: 64, width_px: 32}", ["'width_px' twice", "each key once"]),
        ("dataset.seed=true", ["got true, expected an integer"]),
        ("dataset.camera.weight_on_moon=1", ["got an unknown key, expected one of width_px, height_px, "]),
    ],
)
def test_an_invalid_setting_gives_one_line(setting, parts):
    text = fault(settings=(setting,))
    for part in parts:
        assert part in text


def test_an_unknown_preset():
    with pytest.raises(UserError, match="small"):
        resolve(DatasetConfig, "dataset", "perilune_render", "smal")


@pytest.mark.parametrize(
    "content", ["dataset: [1, 2]", "- a", "dataset: {a: 1", "a: &x [1]\nb: *x", "!!python/object:os.system {}"]
)
def test_files_that_are_not_configurations(tmp_path, content):
    file = tmp_path / "a.yaml"
    file.write_text(content)
    assert "a.yaml" in fault(config_file=file)


def test_a_missing_file(tmp_path):
    assert "no such file" in fault(config_file=tmp_path / "none.yaml")


def test_other_sections_are_allowed_in_the_same_file(tmp_path):
    file = tmp_path / "a.yaml"
    file.write_text("detect: {anything: 1}\ndataset: {seed: 9}")
    assert dataset(config_file=file).seed == 9


WRONG = ["'text'", -1e9, 1e9, 1.5, 0, 1, True, None, [], [1] * 99, ["a"], [[1]], {}, {"zzz": 1}, float("inf"), "a:b"]


@pytest.mark.parametrize(
    ("section", "model"),
    [("dataset", DatasetConfig), ("detect", DetectConfig), ("navigate", NavigateConfig), ("explain", ExplainConfig)],
)
def test_errors_of_all_settings_have_got_and_expected(section, model):
    """No message contains text of the validation library."""
    package = "perilune_render" if section == "dataset" else "perilune_train"
    preset = resolve(model, section, package, "tiny").model_dump(mode="json")
    messages = []

    def visit(content, path):
        for key, value in content.items():
            for wrong in WRONG:
                setting = copy.deepcopy(preset)
                functools.reduce(dict.__getitem__, path, setting)[key] = wrong
                try:
                    resolve_over(model, section, "file.yaml", setting)
                except UserError as error:
                    messages.append(str(error))
            if isinstance(value, dict):
                visit(value, [*path, key])

    visit(preset, [])
    assert len(messages) > 50
    form = re.compile(rf"file\.yaml: {section}[\w.]*: got .+, expected \S.*")
    odd = re.compile(r"input|should|valid |value error|dictionary|expected [A-Z]|List |Tuple ", re.DOTALL)
    for message in messages:
        assert form.fullmatch(message) and not odd.search(message.rpartition("expected ")[2]), message


def test_a_setting_is_a_path_and_a_value():
    assert parse_setting("detect.strides=[4, 8, 16]") == (["detect", "strides"], [4, 8, 16])


def test_a_written_section_reads_back(tmp_path):
    config = dataset(settings=("dataset.seed=11",))
    file = tmp_path / "a.yaml"
    file.write_text(to_yaml("dataset", config))
    assert dataset(config_file=file) == config


def test_a_configuration_is_frozen():
    with pytest.raises(ValidationError):
        dataset().seed = 3


@pytest.mark.parametrize("preset", ["tiny", "small", "paper", "large"])
def test_every_preset_is_valid(preset):
    assert resolve(DatasetConfig, SECTIONS[0], "perilune_render", preset).seed >= 0
