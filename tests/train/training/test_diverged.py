"""A training whose loss explodes or becomes NaN ends with a message."""

import lightning
import pytest
import torch
from torch import nn

from perilune_shared.errors import UserError
from perilune_train.training.fit import Hardware, Schedule, Wording, fit
from perilune_train.training.runs import RunFolder


class Diverging(lightning.LightningModule):
    """Three steps an epoch; in the second step of epoch 2 something goes wrong."""

    def __init__(self, fault: str):
        super().__init__()
        self.fault = fault
        self.architecture: dict[str, object] = {}
        self.network = self.evaluated = nn.Linear(1, 1)

    def train_dataloader(self):
        return torch.utils.data.DataLoader(torch.utils.data.TensorDataset(torch.ones(3, 1)))

    def val_dataloader(self):
        return self.train_dataloader()

    def training_step(self, batch, batch_idx):
        loss = self.network(batch[0]).square().mean() + 1.0
        factor = {"explodes": 1e6, "becomes NaN": float("nan"), "becomes infinite": float("inf"), "rises": 100.0}
        return loss * factor.get(self.fault, 1.0) if self.current_epoch == 1 and batch_idx == 1 else loss

    def on_validation_start(self):
        if self.fault == "ruins the weights" and self.current_epoch == 1:
            nn.init.constant_(self.network.weight, float("nan"))

    def validation_step(self, batch, batch_idx):
        self.log("val/error", 1.0)

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.0)


def train(tmp_path, fault, accumulate=1):
    run = RunFolder(tmp_path / "a")
    schedule = Schedule(3, "val/error", "min", accumulate=accumulate)
    wording = Wording("line", "detect.learning_rate, which is 0.1")
    fit(run, Diverging(fault), schedule, Hardware("cpu", precision="float32"), wording)
    return run


@pytest.mark.parametrize(
    ("fault", "found"),
    [
        ("explodes", r"1e\+06|[0-9.]+e\+06"),
        ("becomes NaN", "nan"),
        ("becomes infinite", "inf"),
        ("ruins the weights", "weights that are not finite"),
    ],
)
def test_it_names_the_epoch_the_loss_and_what_to_lower(tmp_path, fault, found):
    with pytest.raises(UserError, match=f"loss in epoch 2: got ({found}).*lower detect.learning_rate, which is 0.1"):
        train(tmp_path, fault)
    run = RunFolder(tmp_path / "a")
    assert run.last.is_file() and not run.finished
    saved = torch.load(run.last, weights_only=True)
    assert saved["epoch"] == 0, "the state from before"
    assert all(bool(torch.isfinite(tensor).all()) for tensor in saved["state_dict"].values())


@pytest.mark.parametrize("accumulate", [1, 3])
def test_a_loss_that_varies_is_none(tmp_path, accumulate):
    assert train(tmp_path, "rises", accumulate).best.is_file()
