"""`config` prints every key with its meaning and default, as a file that can be given again."""

import itertools

import pytest

from perilune_render.cli.main import main as render_main
from perilune_render.config.dataset import DatasetConfig
from perilune_shared.config.page import annotated_yaml
from perilune_shared.config.resolve import Section, resolve
from perilune_train.cli.main import SECTIONS
from perilune_train.cli.main import main as train_main
from tests.helpers import in_process

MODELS = [("dataset", DatasetConfig, "perilune_render"), *((name, m, "perilune_train") for name, m in SECTIONS.items())]
CHANGES = {
    "dataset": ("dataset.detect.flight.azimuth_deg={low: 5, high: 9}", "dataset.terrain.craters.profile=pangu"),
    "detect": ("detect.init_from='a b: c.ckpt'", "detect.strides=[8, 16, 32]"),
}


@pytest.mark.parametrize(("section", "model", "package"), MODELS)
@pytest.mark.parametrize("preset", ["tiny", "small", "paper", "large"])
def test_the_page_is_a_file_that_gives_the_same_settings(section, model, package, preset, tmp_path):
    config = resolve(model, section, package, preset, None, CHANGES.get(section, ()))
    path = tmp_path / "own.yaml"
    path.write_text(annotated_yaml(section, config))
    assert resolve(model, section, package, "tiny", path) == config


@pytest.mark.parametrize(("section", "model", "package"), MODELS)
def test_every_key_has_a_meaning_and_a_default(section, model, package):
    lines = annotated_yaml(section, resolve(model, section, package, "small")).split("\n")
    for above, line in itertools.pairwise(lines):
        if line.strip() and not line.strip().startswith("#"):
            assert above.strip().startswith("#") or above.rstrip().endswith(":"), line
    assert not missing(model)


def missing(model: type[Section]) -> list[str]:
    """Fields without a docstring, here and in sections below."""
    found = []
    for name, field in model.model_fields.items():
        if not field.description:
            found.append(f"{model.__name__}.{name}")
        if isinstance(field.annotation, type) and issubclass(field.annotation, Section):
            found += missing(field.annotation)
    return found


@pytest.mark.parametrize(
    ("main", "line"),
    [
        (render_main, "    # Image width, pixels. Default: 256."),
        (train_main, "  # Factor on all channel counts; 1 is the paper's network. Default: 1.0."),
    ],
)
def test_command_line(main, line):
    command = [main, "config", "--show", "--preset", "tiny"]
    done = in_process.call(*command)
    assert done.returncode == 0 and line in done.stdout.split("\n")
    wrong = in_process.call(*command, "--set", "dataset.cameras=1", "--set", "detect.widht=1")
    assert wrong.returncode == 2 and wrong.stdout == "" and len(wrong.stderr.strip().split("\n")) == 1
