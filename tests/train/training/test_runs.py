"""Weights, training, resuming."""

import json
import os
import platform
import subprocess
import sys

import lightning
import numpy as np
import pytest
import torch
from torch import nn

import perilune_train
from perilune_shared.config.resolve import Section
from perilune_shared.errors import UserError
from perilune_shared.run_record import run_record
from perilune_train.data.epochs import EpochBatches, batch_loader
from perilune_train.records.metrics_file import write_metrics
from perilune_train.training import fit as fitting
from perilune_train.training import runs
from perilune_train.training.begin import start_run
from perilune_train.training.runs import RunFolder


class Settings(Section):
    rate: float = 0.1


def started(root, name="a"):
    """The folder of a run that has just begun."""
    run = RunFolder(root / "detect" / name)
    start_run(run, "detect", Settings(), {}, "new")
    return run


@pytest.mark.slow
def test_a_process_that_lightning_starts_knows_at_once_that_it_is_not_the_first():
    ask = "from perilune_train.training.runs import is_first_process; print(is_first_process())"
    own = {**os.environ, "LOCAL_RANK": "1"}
    done = subprocess.run([sys.executable, "-c", ask], env=own, capture_output=True, text=True)
    assert done.stdout == "False\n", done.stderr


def test_metrics_are_plain_json(tmp_path):
    run = runs.RunFolder(tmp_path)
    write_metrics(run.root, {"a": 1, "b": float("nan"), "c": "text", "d": 0.5})
    found = json.loads(run.metrics.read_text())
    assert {key: found[key] for key in "abcd"} == {"a": 1, "b": None, "c": "text", "d": 0.5}
    assert found["run/commit"] == run_record().commit
    assert {key for key in found if len(key) > 1} == {
        f"run/{key}" for key in ("commit", "hardware", "load", "command", "date", "gpu", "versions")
    }
    versions = (
        f"perilune_train {perilune_train.__version__}, torch {torch.__version__}, numpy {np.__version__}, Python "
    )
    assert found["run/versions"] == versions + platform.python_version()


def test_weights_come_back(tmp_path):
    path = tmp_path / "best.ckpt"
    network = nn.Linear(3, 2)
    runs.save_weights(path, {"width": 0.5}, network)
    content = runs.load_weights(path)
    assert content["architecture"] == {"width": 0.5}
    other = nn.Linear(3, 2)
    runs.load_state(other, content["state_dict"], path)
    assert torch.equal(other.weight, network.weight)


def test_another_architecture_is_named(tmp_path):
    path = tmp_path / "best.ckpt"
    with pytest.raises(UserError, match=r"weight: got \(2, 3\), expected \(2, 4\)"):
        runs.load_state(nn.Linear(4, 2), nn.Linear(3, 2).state_dict(), path)
    with pytest.raises(UserError, match="bias: got nothing, expected"):
        runs.load_state(nn.Linear(3, 2), nn.Linear(3, 2, bias=False).state_dict(), path)
    with pytest.raises(UserError, match=r"bias: .* expected no such tensor"):
        runs.load_state(nn.Linear(3, 2, bias=False), nn.Linear(3, 2).state_dict(), path)
    with pytest.raises(UserError, match=r"width: got 0.5, expected 1.0"):
        runs.check_architecture(path, {"width": 0.5, "attention": "none"}, {"attention": "none", "width": 1.0})


class Payload:
    """What a pickle could smuggle in."""


@pytest.mark.parametrize("content", [b"", b"not a checkpoint", "pickle", "plain", "cut"])
def test_what_is_no_checkpoint_is_refused_in_one_line(tmp_path, content):
    path = tmp_path / "best.ckpt"
    if content == "pickle":
        torch.save({"architecture": Payload(), "state_dict": {}}, path)
    elif content == "plain":
        torch.save({"weights": torch.zeros(2)}, path)
    elif content == "cut":
        runs.save_weights(path, {}, nn.Linear(3, 2))
        path.write_bytes(path.read_bytes()[:200])
    else:
        path.write_bytes(content)
    with pytest.raises(UserError) as caught:
        runs.load_weights(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match="no such file"):
        runs.load_weights(tmp_path / "absent.ckpt")


def test_damaged_weights_are_refused_in_one_line(tmp_path, recwarn):
    """Single bytes, as a failing disk changes them: torch answers with a dozen kinds of error."""
    path = tmp_path / "best.ckpt"
    runs.save_weights(path, {"width": 0.5}, nn.Linear(3, 2))
    whole, rng, refused = path.read_bytes(), np.random.default_rng(0), 0
    for _ in range(300):
        damaged = bytearray(whole)
        for place in rng.integers(len(whole), size=5):
            damaged[place] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            runs.load_weights(path)
        except UserError as error:
            refused += 1
            assert "\n" not in str(error)
    assert refused > 50 and not recwarn.list


class Points(torch.utils.data.Dataset):
    """A number that follows from epoch and place."""

    def __getitem__(self, key):
        return torch.randn(1, generator=torch.Generator().manual_seed(100 * key[0] + key[1]))


class Line(lightning.LightningModule):
    """Fits y = 2 x; data follow from the epoch. Stops dead in `dies_in`, as a killed process would."""

    def __init__(self, dies_in: int | None = None, workers: int = 0):
        super().__init__()
        self.workers = workers
        self.architecture = {"kind": "line"}
        self.network = nn.Linear(1, 1)
        nn.init.zeros_(self.network.weight)
        nn.init.zeros_(self.network.bias)
        self.evaluated = self.network
        self.dies_in = dies_in

    def train_dataloader(self):
        epoch = self.trainer.fit_loop.epoch_progress.current.processed
        batches = EpochBatches(lambda epoch: [(epoch, place) for place in range(12)], 12, 4, epoch)
        return batch_loader(Points(), batches, torch.stack, self.workers, pinned=False)

    def val_dataloader(self):
        return torch.utils.data.DataLoader(torch.utils.data.TensorDataset(torch.ones(1, 1)))

    def training_step(self, batch, batch_idx):
        if self.current_epoch == self.dies_in and batch_idx == 1:
            raise KeyError("killed")
        return (self.network(batch) - 2 * batch).square().mean()

    def validation_step(self, batch, batch_idx):
        self.log("val/error", (self.network(batch[0]) - 2).abs().mean())

    def configure_optimizers(self):
        return torch.optim.Adam(self.parameters(), 0.1)


def fit(run, task, epochs, resume=False):
    schedule = fitting.Schedule(epochs, "val/error", "min")
    hardware = fitting.Hardware("cpu", precision="float32")
    return fitting.fit(run, task, schedule, hardware, fitting.Wording("line"), resume)


def test_a_resumed_run_repeats_the_uninterrupted_one(tmp_path):
    whole = Line()
    fit(started(tmp_path, "whole"), whole, 4)
    killed = started(tmp_path, "killed")
    with pytest.raises(KeyError):
        fit(killed, Line(dies_in=2), 4)
    assert killed.last.is_file()
    # Workers load ahead, in the right epoch too.
    rest = Line(workers=1)
    fit(killed, rest, 4, resume=True)
    assert rest.trainer.global_step == whole.trainer.global_step == 12
    assert torch.equal(rest.network.weight, whole.network.weight)
    best = runs.load_weights(killed.best)
    assert best["architecture"] == {"kind": "line"}
    assert (best["state_dict"]["weight"] - 2).abs() < 2


def test_a_resumed_run_took_the_time_of_all_its_parts(tmp_path):
    run = started(tmp_path, "a")
    with pytest.raises(KeyError):
        fit(run, Line(dies_in=2), 3)
    state = torch.load(run.last, weights_only=True)
    assert 0 < state["callbacks"]["KeepLast"]["seconds"] < 60
    state["callbacks"]["KeepLast"]["seconds"] = 1000.0
    torch.save(state, run.last)
    assert 1000 < fit(run, Line(), 3, resume=True) < 1060
    assert 1000 < fit(run, Line(), 3, resume=True) < 1060
    assert fit(run, Line(), 3) < 60


@pytest.mark.parametrize("fault", ["cut", "empty", "best", "other", "text"])
def test_a_last_state_that_cannot_be_gone_on_with(tmp_path, fault):
    run = started(tmp_path, "a")
    task = Line()
    fit(run, task, 1)
    if fault == "other":
        task.network = nn.Linear(2, 1)
    else:
        state = run.last.read_bytes()
        contents = {"cut": state[: len(state) // 2], "empty": b"", "best": run.best.read_bytes(), "text": b"state"}
        run.last.write_bytes(contents[fault])
    with pytest.raises(UserError) as caught:
        fit(run, task, 2, resume=True)
    message = str(caught.value)
    assert message.startswith(f"{run.last}: ") and "\n" not in message
    assert ("weight: got (1, 1), expected (1, 2)" if fault == "other" else "--overwrite replaces it") in message


def test_best_keeps_the_best_not_the_last(tmp_path):
    class Worse(Line):
        def on_validation_epoch_end(self):
            self.network.weight.data.fill_(float(self.current_epoch))

        def validation_step(self, batch, batch_idx):
            self.log("val/error", torch.tensor([0.5, 0.1, 0.7][self.current_epoch]))

    run = started(tmp_path, "w")
    fit(run, Worse(), 3)
    assert runs.load_weights(run.best)["state_dict"]["weight"].item() == 1.0


def test_device_and_precision():
    assert runs.choose_bf16("bf16", "cpu") is True
    assert runs.choose_bf16("float32", "cpu") is False
    assert runs.choose_device("cpu") == "cpu"
    if not torch.cuda.is_available():
        assert runs.choose_device("auto") == "cpu"
        with pytest.raises(UserError, match="torch finds no GPU"):
            runs.choose_device("cuda")


@pytest.mark.parametrize("hardware", [True, False])
def test_emulated_bfloat16_does_not_count(monkeypatch, hardware):
    """A GPU without bfloat16: torch reports it as supported unless asked to leave out emulation."""

    def supported(including_emulation: bool = True) -> bool:
        return including_emulation or hardware

    monkeypatch.setattr(torch.cuda, "is_bf16_supported", supported)
    assert runs.choose_bf16("auto", "cuda") is hardware
