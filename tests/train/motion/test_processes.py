"""Navigation trained by two processes: shares, equal weights, resuming."""

import subprocess
from pathlib import Path

import pytest
import torch
from tests.helpers import forked

from perilune_shared.errors import UserError
from perilune_train.motion.config import NavigateConfig
from perilune_train.motion.train.navigate_run import navigate_run
from perilune_train.training.runs import NamedRun

pytestmark = pytest.mark.slow

_NETWORK = {
    "size_px": 64,
    "width": 0.125,
    "hidden": 16,
    "sequence_pairs": 4,
    "batch_sequences": 2,
    "coarse_epochs": 1,
    "fine_epochs": 1,
    "learning_rate": 1e-3,
}
SETTINGS = NavigateConfig(
    precision="float32", device="cpu", warp={**_NETWORK, "jitter": 1.0}, stack={**_NETWORK, "coarse_epochs": 0}
)


def train(dataset: Path, out: Path, name: str, stop: str = "") -> subprocess.CompletedProcess[str]:
    """Both networks in two processes; with `stop` ("fusion epoch") interrupted there."""
    script = Path(__file__).with_name("two_processes.py")
    log = out / f"{name}{stop}.log"
    return forked.run(script, log, str(dataset), str(out), name, SETTINGS.model_dump_json(), stop)


@pytest.fixture(scope="module")
def trained(dataset_nav, tmp_path_factory):
    """Folder of a run of two processes."""
    out = tmp_path_factory.mktemp("two")
    done = train(dataset_nav, out, "whole")
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("load train") == done.stderr.count("train warp") == done.stderr.count("train stack") == 1
    return out


def test_two_processes_share_the_sequences_and_end_with_equal_weights(trained):
    first, second = (torch.load(trained / f"whole.{process}.pt", weights_only=True) for process in (0, 1))
    for fusion, epochs in (("stack", 1), ("warp", 2)):
        mine, other = first[fusion], second[fusion]
        # Four trajectories of 7 pairs, two sequences of 4 pairs from each.
        assert len(mine["seen"]) == len(other["seen"]) == 4 * epochs
        assert {key[2] for key in mine["seen"]} == {0, 2} and {key[2] for key in other["seen"]} == {1, 3}
        for epoch in range(epochs):
            assert sorted(key[1] for key in mine["seen"] + other["seen"] if key[0] == epoch) == list(range(8))
        # Batch statistics are those of each process after the last validation, in which they were equal.
        assert mine["state"].keys() == other["state"].keys()
        assert [key for key, value in mine["state"].items() if not torch.equal(value, other["state"][key])] == []
        assert mine["figures"] == other["figures"] and len(mine["figures"]) == 2
        folder = trained / "navigate" / ("whole" if fusion == "warp" else "whole-stack")
        assert (folder / "metrics.json").is_file() and len(list(folder.glob("events*"))) == 1
        saved = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]
        assert all(torch.equal(value, mine["state"][key]) for key, value in saved.items())


def test_an_interrupted_run_of_two_processes_is_resumed_only_by_two(dataset_nav, trained, tmp_path):
    assert train(dataset_nav, tmp_path, "again", stop="warp 1").returncode != 0
    finished = [folder.name for folder in (tmp_path / "navigate").iterdir() if (folder / "metrics.json").is_file()]
    assert finished == []
    with pytest.raises(UserError, match=r"last.ckpt: processes: got 1, expected 2, as in the existing run"):
        navigate_run(SETTINGS, dataset_nav, NamedRun(tmp_path, "again"), None)
    done = train(dataset_nav, tmp_path, "again")
    assert done.returncode == 0, done.stderr
    for name in ("", "-stack"):
        whole, resumed = (
            torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]
            for folder in (trained / "navigate" / f"whole{name}", tmp_path / "navigate" / f"again{name}")
        )
        assert whole.keys() == resumed.keys() and all(torch.equal(whole[key], resumed[key]) for key in whole)
