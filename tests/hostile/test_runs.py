"""Run folders: two trainings at once, and files that are empty or cut."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from perilune_shared.storage.locks import locked
from perilune_train.cli.main import main
from perilune_train.detect.inference.detector import load_detector
from perilune_train.detect.train import detect_run as detect_training
from perilune_train.explain import explain_run as explaining
from perilune_train.motion.train import navigate_run as navigate_training
from perilune_train.records.metrics_file import write_metrics
from perilune_train.training.runs import RunFolder, save_weights
from tests.helpers.stored_run import store_run
from tests.hostile.measured import accepted, refused

# The commands import these only when they need them; imports would count as memory.
IMPORTED = (detect_training, explaining, navigate_training)


@pytest.mark.parametrize("command", ["detect train", "navigate train", "explain", "causal"])
def test_a_run_folder_that_another_training_holds(command: str, tmp_path: Path) -> None:
    parts = command.split()
    kind = "explain" if parts[0] == "causal" else parts[0]
    name = "a-causal" if parts[0] == "causal" else "a"
    with locked(tmp_path / kind / name):
        refused(
            f"{command}: held",
            main,
            *parts,
            *("--preset", "tiny", "--name", "a", "--runs", tmp_path, "--dataset", tmp_path / "absent"),
            naming="locked by PID",
        )
    assert not (tmp_path / kind / name).exists(), "nothing is left beside the lock"


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def empty(path: Path) -> None:
    path.write_bytes(b"")


@pytest.fixture
def stored(tmp_path: Path) -> RunFolder:
    return RunFolder(store_run(tmp_path))


@pytest.mark.parametrize("damage", [empty, cut])
@pytest.mark.parametrize("part", ["metrics", "best"])
def test_a_run_with_a_damaged_file_is_not_finished(
    stored: RunFolder, part: str, damage: Callable[[Path], None]
) -> None:
    assert stored.finished
    damage(getattr(stored, part))
    assert not stored.finished and stored.damaged == getattr(stored, part)
    arguments = ("detect", "train", "--runs", stored.root.parent.parent, "--name", stored.root.name)
    refused(f"{damage.__name__} {part}", main, *arguments, naming="an empty or damaged file")
    assert stored.best.is_file() and stored.config.is_file(), "nothing is replaced unasked"


@pytest.mark.parametrize("content", ["{}", "[]", "null", '{"a": [1]}', "[" * 100_000])
def test_metrics_that_are_no_metrics(stored: RunFolder, content: str) -> None:
    stored.metrics.write_text(content)
    assert not stored.finished


def test_weights_as_safetensors_that_are_cut(stored: RunFolder) -> None:
    from perilune_train.training.half_weights import write_half
    from perilune_train.training.runs import load_weights

    weights = stored.root / "weights.safetensors"
    write_half(weights, load_weights(stored.best))
    assert stored.finished and stored.best == weights
    cut(weights)
    assert not stored.finished


def test_a_finished_run_is_left_unchanged(stored: RunFolder) -> None:
    before = {path: path.read_bytes() for path in stored.root.rglob("*") if path.is_file()}
    settings = ("width=0.125", "precision=float32", "device=cpu", "evaluation.min_score=0.001")
    sets = [part for setting in settings for part in ("--set", f"detect.{setting}")]
    arguments = ("detect", "train", "--preset", "tiny", "--runs", stored.root.parent.parent, "--name", "stored")
    ended = accepted("finished", main, *arguments, *sets)
    assert "finished, left unchanged" in ended.output
    assert before == {path: path.read_bytes() for path in stored.root.rglob("*") if path.is_file()}


@pytest.mark.parametrize("script", ["paper", "demo"])
def test_scripts_look_into_the_files(script: str, tmp_path: Path) -> None:
    """An empty metrics.json is not the end of a step."""
    from importlib import util

    spec = util.spec_from_file_location(script, Path(__file__).parents[2] / "scripts" / f"{script}.py")
    assert spec is not None and spec.loader is not None
    module = util.module_from_spec(spec)
    import sys

    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    done = module._finished(tmp_path) if script == "paper" else lambda: module.has_metrics(tmp_path)
    assert not done()
    (tmp_path / "metrics.json").write_bytes(b"")
    assert not done()
    write_metrics(tmp_path, {"a": 1.0})
    assert done()
    if script == "paper":
        (tmp_path / "checkpoints").mkdir()
        (tmp_path / "checkpoints" / "best.ckpt").write_bytes(b"")
        assert not done()
        save_weights(tmp_path / "checkpoints" / "best.ckpt", {}, torch.nn.Linear(1, 1))
        assert done()
    assert json.loads((tmp_path / "metrics.json").read_text())["a"] == 1.0
    shutil.rmtree(tmp_path)


def test_weights_are_written_to_be_shared(stored: RunFolder, tmp_path: Path) -> None:
    out = tmp_path / "weights.safetensors"
    accepted("shared", main, "detect", "weights", stored.best, "--out", out, memory_mb=600)
    shutil.copy(out, stored.root)
    assert stored.finished and stored.best.name == out.name
    load_detector(stored.best)
