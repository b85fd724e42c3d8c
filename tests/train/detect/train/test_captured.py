"""Frames that stay on the device, and whole steps in place of Lightning's: the same training."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from perilune_shared.config.resolve import resolve
from perilune_shared.dataset.manifest import open_dataset
from perilune_train.detect.config import DetectConfig, LabelSettings
from perilune_train.detect.data.batches import network_input, training_loader
from perilune_train.detect.data.resident import ResidentFrames, fits, may_reside, resident_loader
from perilune_train.detect.data.split import load_split
from perilune_train.detect.train.detect_run import run_detect
from perilune_train.detect.train.loss import detection_loss
from perilune_train.detect.train.task import DetectTask
from perilune_train.training.runs import load_weights

PLAIN = (
    "detect.augment={flips_and_turns: false, scale: [1, 1], gain: 0, gamma: 0, stretch: 0, blur_px: 0, noise: 0}",
    "detect.loss={lambda_guide: 0}",
    "detect.width=0.125",
    "detect.precision=float32",
    "detect.device=cpu",
    "detect.batch_size=4",
)


def settings(*more):
    return resolve(DetectConfig, "detect", "perilune_train", "tiny", None, (*PLAIN, *more))


@pytest.fixture(scope="module")
def split(dataset_detect):
    return load_split(open_dataset(dataset_detect), "train", LabelSettings())


@pytest.mark.parametrize("assignment", ["one", "several"])
@pytest.mark.parametrize("reduction", ["means", "sums"])
@pytest.mark.parametrize("objectness", ["hard", "iou"])
def test_losses_of_a_resident_batch_are_those_of_the_loader(split, assignment, reduction, objectness):
    config = settings(f"detect.assignment={assignment}")
    loss = config.loss.model_copy(update={"reduction": reduction, "objectness": objectness})
    anchors = torch.tensor([[[4.0, 4], [6, 6], [8, 8]], [[12, 12], [16, 16], [20, 20]], [[30, 30], [40, 40], [60, 60]]])
    resident = ResidentFrames.of(split, config, anchors, torch.device("cpu"))
    random = torch.Generator().manual_seed(0)
    for (frames, targets), numbers in zip(
        training_loader(split, config, anchors), resident_loader(split, config), strict=True
    ):
        images, padded = resident.batch(numbers, 3)
        np.testing.assert_allclose(images, network_input(frames, 3), atol=1e-5)
        outputs = []
        for target in targets:
            assert target.counted is None
            outputs.append(torch.randn(*target.ignored.shape, 5, generator=random, requires_grad=True))
        losses = []
        for given in (targets, padded):
            box, confidence = detection_loss(outputs, given, anchors, config.strides, loss)
            losses.append([box, confidence, *torch.autograd.grad(box + confidence, outputs)])
        for one, other in zip(*losses, strict=True):
            torch.testing.assert_close(one, other)


def test_whole_steps_train_as_ordinary_ones(dataset_detect, tmp_path, monkeypatch):
    # Adam moves weights whose gradient is nearly 0 by the whole rate in the direction of its rounding.
    config = settings("detect.epochs=2", "detect.learning_rate=1e-4", "detect.ema_decay=0")
    ordinary = run_detect(config, dataset_detect, tmp_path / "ordinary", "a")
    monkeypatch.setattr(DetectTask, "resides", property(lambda task: may_reside(task.config)))
    whole = run_detect(config, dataset_detect, tmp_path / "whole", "a")
    runs = [load_weights(run.best)["state_dict"] for run in (ordinary, whole)]
    lr = config.learning_rate
    for name, value in runs[0].items():
        torch.testing.assert_close(value, runs[1][name], rtol=1e-2, atol=4 * lr, msg=name)
    difference = torch.cat([(value - runs[1][name]).flatten() for name, value in runs[0].items() if value.ndim > 1])
    assert difference.abs().mean() < 0.05 * lr


def test_frames_may_take_a_quarter_of_a_gpu(split, monkeypatch):
    for times, expected in ((4, True), (3, False)):
        memory = SimpleNamespace(total_memory=times * split.frames.images.nbytes)
        monkeypatch.setattr(torch.cuda, "get_device_properties", lambda _, memory=memory: memory)
        assert fits(split, torch.device("cuda")) == expected


def test_only_plain_training_may_reside():
    assert may_reside(settings())
    assert not may_reside(settings("detect.augment.gain=0.1"))
    assert not may_reside(settings("detect.loss.lambda_guide=0.1"))
    assert not may_reside(settings("detect.devices=2"))
    assert not may_reside(settings("detect.stream=true"))
