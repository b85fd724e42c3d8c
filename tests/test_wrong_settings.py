"""Wrong values of every setting are refused in our own words, never in pydantic's."""

import copy
import json
import re
import typing
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from pydantic import BaseModel

from perilune_render.cli import frames
from perilune_render.config.dataset import DatasetConfig
from perilune_render.server.native import answers
from perilune_shared.config.resolve import Section, resolve
from perilune_shared.config.yaml_text import parse_yaml
from perilune_shared.dataset.info_file import checked_info
from perilune_shared.editing import migrate
from perilune_shared.errors import UserError
from perilune_train.cli.main import SECTIONS
from perilune_train.landing.fly import settings

MODELS = [("dataset", DatasetConfig, "perilune_render"), *((name, m, "perilune_train") for name, m in SECTIONS.items())]
WRONG = (
    *("null", "true", "-1", "1.5", "1e400", "x", "''", "[]", "[1, 2, 3]", "[a]", "[[1]]", "[null]"),
    *("{}", "{low: 1}", "{low: 5, high: 1}", "{1: [2]}", "{a: {}}", "{a: {b: {}}}", "99999999999999999999", "1:30"),
)
THEIRS = re.compile(
    r"[Ii]nput should|valid (integer|number|string|boolean|array|object|dictionary)|unable to (parse|interpret)|Field "
    r"required|not permitted|\[key\]|expected (expected|must|$)|validation error|pydantic|one of $",
)


def settings_of(model: type[BaseModel], prefix: str) -> Iterator[str]:
    """Names of all settings, of those below other sections too."""
    for name, field in model.model_fields.items():
        yield f"{prefix}.{name}"
        for section in sections_in(field.annotation):
            yield from settings_of(section, f"{prefix}.{name}")


def sections_in(annotation: object) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for part in typing.get_args(annotation) for found in sections_in(part)]


@pytest.mark.parametrize(("section", "model", "package"), MODELS)
def test_no_sentence_of_pydantic_reaches_a_user(section: str, model: type[Section], package: str):
    messages = []
    for setting in dict.fromkeys(settings_of(model, section)):
        for value in WRONG:
            try:
                resolve(model, section, package, "tiny", None, (f"{setting}={value}",))
            except UserError as error:
                messages.append(str(error))
    assert len(messages) > 100
    assert not [message for message in messages if THEIRS.search(message)]


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("dataset.counterfactual.removed={low: [1]}", "removed: got the key 'low', expected an integer"),
        (
            "dataset.cameras={left: {widht_px: 5}}",
            "cameras.left.widht_px: got an unknown key, expected width_px",
        ),
        (
            "dataset.cameras={left: {mounting: {x: 5}}}",
            "mounting.x: got an unknown key, expected one of",
        ),
        ("dataset.scene={views: [{x: 1}]}", "views.0."),
        ("dataset.labels.max_radius_px=1", "labels: got max_radius_px 1, expected min_radius_px below max_radius_px"),
    ],
)
def test_what_is_wrong_is_named(setting, message):
    with pytest.raises(UserError) as raised:
        resolve(DatasetConfig, "dataset", "perilune_render", "tiny", None, (setting,))
    assert message in str(raised.value)


PRIOR = {
    "position_m": [0, 0, 900], "velocity_mps": [0, 0, -30], "rotation_wxyz": [0, 1, 0, 0], "position_sigma_m": 2.0,
    "velocity_sigma_mps": 0.1, "attitude_sigma_deg": 0.1, "inertial": {"gyro_bias_deg_per_h": 1.0},
    "site_latitude_deg": 1, "site_longitude_deg": 2,
    "catalogue_columns": {"longitude_deg": "l", "latitude_deg": "b", "radius_km": "r"},
}  # fmt: skip
CAMERA = {
    "width_px": 64, "height_px": 64, "fx_px": 70.0, "fy_px": 70.0, "cx_px": 32.0, "cy_px": 32.0,
    "distortion": [0.0] * 5, "rotation_camera_from_body": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
}  # fmt: skip
FRAME_CAMERA = {"width_px": 64, "height_px": 64, "horizontal_fov_deg": 30, "mounting": {}}
INFO = Path(__file__).parent.parent / "data_manifests/shipped-nav/dataset.json"
OLD = {
    "schema_version": "2", "preset": "tiny", "kind": "nav", "seed": 0, "config": {}, "versions": {},
    "developed_from": {"name": "a", "sha256": "0" * 64},
}  # fmt: skip
REQUEST = {"request": "frame", "position_m": [0, 0, 900], "rotation_wxyz": [0, 1, 0, 0], "scene": 0}


def info() -> dict[str, typing.Any]:
    content = json.loads(INFO.read_text())
    del content["sha256"]
    for recipe in content["recipes"].values():
        recipe["config"] = {}
    return content


READERS: dict[str, tuple[dict[str, typing.Any], Callable[[typing.Any, Path], object]]] = {
    "prior.yaml": (PRIOR, lambda content, path: settings.read_prior(written(path, content))),
    "camera.yaml": (CAMERA, lambda content, path: settings.read_camera(written(path, content))),
    "camera of frames": (FRAME_CAMERA, lambda content, path: frames.read_camera(written(path, content))),
    "dataset.json": (info(), lambda content, path: checked_info(content, path)),
    "dataset.json of version 2": (OLD, lambda content, path: migrate._info(dict(content), str(path))),
    "request": (REQUEST, lambda content, path: answers._parsed(json.dumps(content).encode())),
}


def written(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path


def changes(content: dict[str, typing.Any]) -> Iterator[dict[str, typing.Any]]:
    """Content with each value changed to every wrong one, and with an unknown key at each level."""
    for place in places(content):
        for text in (*WRONG, "1.0e300"):
            if text in ("1e400", "{1: [2]}"):
                continue
            changed, value = copy.deepcopy(content), parse_yaml(text, "value")
            above: typing.Any = changed
            for key in place[:-1]:
                above = above[key]
            above[place[-1]] = value
            yield changed


def places(tree: object, above: tuple = ()) -> Iterator[tuple]:
    pairs = [*tree.items(), ("unknown", None)] if isinstance(tree, dict) else []
    pairs = [*enumerate(tree)][:2] if isinstance(tree, list) else pairs
    for key, value in pairs:
        yield (*above, key)
        yield from places(value, (*above, key))


@pytest.mark.filterwarnings("ignore:(overflow|invalid value) encountered")
@pytest.mark.parametrize("name", READERS)
def test_no_foreign_sentence_about_a_file_or_a_request(name: str, tmp_path: Path):
    content, read = READERS[name]
    messages = []
    for changed in changes(content):
        try:
            read(changed, tmp_path / "file.yaml")
        except UserError as error:
            messages.append(str(error))
    assert len(messages) > 50
    theirs = [message for message in messages if THEIRS.search(message) or message.endswith("expected another value")]
    assert theirs == []


def test_a_missing_field_of_a_file_is_named_without_the_file():
    content = {**info(), "schema_version": "4"}
    del content["name"]
    with pytest.raises(UserError, match=r"^dataset.json: name: got nothing, expected a value$"):
        checked_info(content, "dataset.json")
