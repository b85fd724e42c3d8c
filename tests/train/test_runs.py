"""Run folders, weights, resuming."""

import json

import lightning
import pytest
import torch
from torch import nn

from perilune_shared.config import Section
from perilune_shared.errors import UserError
from perilune_train import fit as fitting
from perilune_train import runs


class Settings(Section):
    rate: float = 0.1


def test_an_older_run_is_replaced_and_nothing_else(tmp_path):
    run = runs.start_run(tmp_path, "detect", "a", Settings(), resume=False)
    assert run.root == tmp_path / "detect" / "a"
    assert run.config.read_text() == "detect:\n  rate: 0.1\n"
    runs.write_metrics(run, {"test/x": 1.0})
    assert run.finished
    assert not runs.start_run(tmp_path, "detect", "a", Settings(), resume=False).finished
    (tmp_path / "detect" / "mine").mkdir()
    (tmp_path / "detect" / "mine" / "notes.txt").write_text("keep")
    with pytest.raises(UserError, match="a folder that is no run"):
        runs.start_run(tmp_path, "detect", "mine", Settings(), resume=False)
    assert (tmp_path / "detect" / "mine" / "notes.txt").exists()


def test_resuming_keeps_the_run_and_needs_its_settings(tmp_path):
    run = runs.start_run(tmp_path, "detect", "a", Settings(), resume=True)
    (run.root / "checkpoints").mkdir()
    run.last.write_text("state")
    assert runs.start_run(tmp_path, "detect", "a", Settings(), resume=True).last.exists()
    with pytest.raises(UserError, match="--resume: found another configuration"):
        runs.start_run(tmp_path, "detect", "a", Settings(rate=0.2), resume=True)
    assert run.last.exists()


def test_metrics_are_plain_json(tmp_path):
    run = runs.RunFolder(tmp_path)
    runs.write_metrics(run, {"a": 1, "b": float("nan"), "c": "text", "d": 0.5})
    assert json.loads(run.metrics.read_text()) == {"a": 1, "b": None, "c": "text", "d": 0.5}


def test_weights_come_back(tmp_path):
    path = tmp_path / "best.ckpt"
    network = nn.Linear(3, 2)
    runs.save_weights(path, {"width": 0.5}, network)
    content = runs.load_weights(path)
    assert content["architecture"] == {"width": 0.5}
    other = nn.Linear(3, 2)
    runs.fill(other, content["state_dict"], path)
    assert torch.equal(other.weight, network.weight)


def test_another_architecture_is_named(tmp_path):
    path = tmp_path / "best.ckpt"
    with pytest.raises(UserError, match=r"weight: found \(2, 3\); wanted \(2, 4\)"):
        runs.fill(nn.Linear(4, 2), nn.Linear(3, 2).state_dict(), path)
    with pytest.raises(UserError, match="bias: found nothing; wanted"):
        runs.fill(nn.Linear(3, 2), nn.Linear(3, 2, bias=False).state_dict(), path)
    with pytest.raises(UserError, match=r"bias: .* wanted no such tensor"):
        runs.fill(nn.Linear(3, 2, bias=False), nn.Linear(3, 2).state_dict(), path)
    with pytest.raises(UserError, match=r"width: found 0.5; wanted 1.0"):
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


class Line(lightning.LightningModule):
    """Fits y = 2 x; data follow from the epoch. Stops dead in `dies_in`, as a killed process would."""

    def __init__(self, dies_in: int | None = None):
        super().__init__()
        self.architecture = {"kind": "line"}
        self.network = nn.Linear(1, 1)
        nn.init.zeros_(self.network.weight)
        nn.init.zeros_(self.network.bias)
        self.evaluated = self.network
        self.dies_in = dies_in

    def train_dataloader(self):
        x = torch.randn(12, 1, generator=torch.Generator().manual_seed(self.current_epoch))
        return torch.utils.data.DataLoader(torch.utils.data.TensorDataset(x), batch_size=4)

    def val_dataloader(self):
        return torch.utils.data.DataLoader(torch.utils.data.TensorDataset(torch.ones(1, 1)))

    def training_step(self, batch, batch_idx):
        if self.current_epoch == self.dies_in and batch_idx == 1:
            raise KeyError("killed")
        return (self.network(batch[0]) - 2 * batch[0]).square().mean()

    def validation_step(self, batch, batch_idx):
        self.log("val/error", (self.network(batch[0]) - 2).abs().mean())

    def configure_optimizers(self):
        return torch.optim.Adam(self.parameters(), 0.1)


def fit(run, task, epochs, resume=False):
    fitting.fit(
        run,
        task,
        label="line",
        epochs=epochs,
        monitor="val/error",
        mode="min",
        resume=resume,
        precision="float32",
        device="cpu",
    )


def test_a_resumed_run_repeats_the_uninterrupted_one(tmp_path):
    whole = Line()
    fit(runs.start_run(tmp_path, "detect", "whole", Settings(), False), whole, 4)
    killed = runs.start_run(tmp_path, "detect", "killed", Settings(), False)
    with pytest.raises(KeyError):
        fit(killed, Line(dies_in=2), 4)
    assert killed.last.is_file()
    rest = Line()
    fit(killed, rest, 4, resume=True)
    assert rest.trainer.global_step == whole.trainer.global_step == 12
    assert torch.equal(rest.network.weight, whole.network.weight)
    best = runs.load_weights(killed.best)
    assert best["architecture"] == {"kind": "line"}
    assert (best["state_dict"]["weight"] - 2).abs() < 2


def test_best_keeps_the_best_not_the_last(tmp_path):
    class Worse(Line):
        def on_validation_epoch_end(self):
            self.network.weight.data.fill_(float(self.current_epoch))

        def validation_step(self, batch, batch_idx):
            self.log("val/error", torch.tensor([0.5, 0.1, 0.7][self.current_epoch]))

    run = runs.start_run(tmp_path, "detect", "w", Settings(), False)
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
