"""Killed and resumed; two processes."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tests.helpers import in_process

from perilune_shared.config.resolve import resolve
from perilune_shared.errors import UserError
from perilune_train.cli.main import main
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.train.detect_run import run_detect

pytestmark = pytest.mark.slow

SETTINGS = ("detect.precision=float32", "detect.device=cpu", "detect.checkpoint_minutes=0")
BATCHES = 6
ALONE = {**os.environ, "OMP_NUM_THREADS": "1"}


def state(path: Path) -> dict:
    return torch.load(path, weights_only=True)


def assert_equal_tensors(first: dict, second: dict) -> None:
    assert first.keys() == second.keys()
    different = [key for key, value in first.items() if not torch.equal(value, second[key])]
    assert not different


@pytest.mark.usefixtures("no_pictures")
def test_killed_within_an_epoch_and_resumed_gives_the_same_weights(few, tmp_path):
    one = "detect.batch_size=1"
    # Only the run that is killed writes a checkpoint after every batch.
    config = resolve(DetectConfig, "detect", "perilune_train", "tiny", None, (*SETTINGS[:2], one))
    whole = run_detect(config, few, tmp_path, "whole")
    command = ["detect", "train", "--preset", "tiny", "--name", "killed"]
    command += ["--dataset", str(few), "--out", str(tmp_path)]
    command += [part for setting in (*SETTINGS, one) for part in ("--set", setting)]
    checkpoint = tmp_path / "detect" / "killed" / "checkpoints" / "last.ckpt"
    program = [sys.executable, str(Path(__file__).with_name("killed_process.py"))]
    killed = subprocess.run([*program, *command], env=ALONE, capture_output=True, text=True, timeout=300)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert state(checkpoint)["epoch_and_batches"] == [1, 2]
    done = in_process.call(main, *command)
    assert done.returncode == 0, done.stderr
    resumed, uninterrupted = state(checkpoint), state(whole.last)
    assert resumed["global_step"] == uninterrupted["global_step"] == 2 * BATCHES
    assert_equal_tensors(resumed["state_dict"], uninterrupted["state_dict"])
    moments = [s["optimizer_states"][0]["state"] for s in (resumed, uninterrupted)]
    for first, second in zip(moments[0].values(), moments[1].values(), strict=True):
        assert_equal_tensors(first, second)
    assert_equal_tensors(state(checkpoint.with_name("best.ckpt"))["state_dict"], state(whole.best)["state_dict"])


def test_two_processes_share_the_frames_and_end_with_equal_weights(few, tmp_path):
    settings = (*SETTINGS[:2], "detect.batch_size=2")
    run = tmp_path / "detect" / "two"
    # The second process has a folder of its own, as on another machine: what lies there does not make it resume alone.
    stale = tmp_path / "other" / "detect" / "two" / "checkpoints" / "last.ckpt"
    stale.parent.mkdir(parents=True)
    stale.write_text("of an older run")
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    script = [str(Path(__file__).with_name("two_processes.py")), str(few), str(tmp_path), *settings]
    done = subprocess.run([*torchrun, *script], env=ALONE, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    first, second = (torch.load(tmp_path / f"{process}.pt", weights_only=True) for process in (0, 1))
    seen = [state.pop("seen") for state in (first, second)]
    assert len(seen[0]) == len(seen[1]) == 6
    assert sorted(seen[0] + seen[1]) == [(epoch, frame) for epoch in range(2) for frame in range(6)]
    assert_equal_tensors(
        {key: value for key, value in first.items() if not key.startswith("network.") or is_weight(key)},
        {key: value for key, value in second.items() if not key.startswith("network.") or is_weight(key)},
    )
    saved = state(run.joinpath("checkpoints", "last.ckpt"))["state_dict"]
    assert_equal_tensors(saved, {key: first[key] for key in saved})
    assert (run / "metrics.json").is_file() and len(list(run.glob("events*"))) == 1
    # Of the two processes, only the first shows progress. It loads the frames once more, to fit their features.
    assert done.stderr.count("train detector") == 1 and done.stderr.count("load train") == 2
    assert stale.read_text() == "of an older run"
    # Position and schedule of the state are those of two processes.
    (run / "metrics.json").unlink()
    config = resolve(DetectConfig, "detect", "perilune_train", "tiny", None, settings)
    with pytest.raises(UserError, match=r"last.ckpt: processes: got 1, expected 2, as in the existing run"):
        run_detect(config, few, tmp_path, "two")


def is_weight(key: str) -> bool:
    return not key.endswith(("running_mean", "running_var"))


def test_lightning_starts_the_processes_without_torchrun(few, tmp_path):
    command = ["detect", "train", "--preset", "tiny", "--name", "two", "--dataset", str(few), "--out", str(tmp_path)]
    settings = (*SETTINGS[:2], "detect.devices=2", "detect.epochs=1", "detect.batch_size=2")
    command += [part for setting in settings for part in ("--set", setting)]
    program = [sys.executable, "-m", "perilune_train.cli.main"]
    done = subprocess.run([*program, *command], env=ALONE, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    saved = state(tmp_path / "detect" / "two" / "checkpoints" / "last.ckpt")
    # Six frames, two in each of two processes in a step.
    assert (saved["processes"], saved["global_step"], saved["images_seen"]) == (2, 2, 6)
    assert (tmp_path / "detect" / "two" / "metrics.json").is_file()
