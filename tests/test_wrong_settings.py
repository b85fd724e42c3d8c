"""Wrong values of every setting are refused in our own words, never in pydantic's."""

import re
import typing
from collections.abc import Iterator

import pytest
from pydantic import BaseModel

from perilune_render.config.dataset import DatasetConfig
from perilune_shared.config.resolve import Section, resolve
from perilune_shared.errors import UserError
from perilune_train.cli.main import SECTIONS

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
