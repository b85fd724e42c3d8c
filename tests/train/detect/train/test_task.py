"""Schedule, moving average, freezing; that the loss learns."""

import numpy as np
import pytest
import torch
from torch import nn

from perilune_shared.dataset.manifest import open_dataset
from perilune_train.detect.config import AugmentSettings, DetectConfig, EvaluationSettings, LabelSettings
from perilune_train.detect.data.batches import evaluation_loader, network_input
from perilune_train.detect.data.split import load_split
from perilune_train.detect.evaluate.metrics import curve
from perilune_train.detect.evaluate.split_evaluation import match_detections
from perilune_train.detect.inference.suppression import detections_of
from perilune_train.detect.train.detect_run import build_network
from perilune_train.detect.train.loss import detection_loss
from perilune_train.detect.train.task import DetectTask, learning_rate_factor, paired_tensors, update_average


def test_learning_rate_by_hand():
    factors = [learning_rate_factor(step, 10, 110) for step in (0, 9, 10, 60, 110, 200)]
    assert factors == pytest.approx([0.1, 1.0, 1.0, 0.01 + 0.99 / 2, 0.01, 0.01])
    # A warm-up longer than half the training is cut.
    assert learning_rate_factor(1, 100, 4) == 1.0


def test_moving_average_by_hand():
    old, new = nn.BatchNorm1d(1), nn.BatchNorm1d(1)
    nn.init.constant_(new.weight, 3.0)
    new.running_mean.fill_(10.0)
    new.num_batches_tracked.fill_(7)
    update_average(paired_tensors(old, new), 0.9)
    assert old.weight.item() == pytest.approx(0.9 * 1 + 0.1 * 3)
    assert old.running_mean.item() == pytest.approx(1.0)
    assert old.num_batches_tracked.item() == 7


def test_weak_and_doubled_predictions_go():
    boxes = torch.tensor([[0.0, 0.0, 8.0, 8.0], [0.0, 0.0, 8.0, 7.0], [20.0, 20.0, 28.0, 28.0], [40.0, 0.0, 48.0, 8.0]])
    (found,) = detections_of(boxes[None], torch.tensor([[0.3, 0.8, 0.001, 0.5]]), EvaluationSettings())
    assert found.boxes[:, 0].tolist() == [0, 40]
    np.testing.assert_allclose(found.scores, [0.8, 0.5])


@pytest.fixture(scope="module")
def split(dataset_detect):
    return load_split(open_dataset(dataset_detect), "train", LabelSettings())


def test_while_frozen_only_gates_and_head_may_learn(split, tmp_path):
    config = DetectConfig(width=0.125, in_channels=1, epochs=3, strides=(4, 8, 16))
    task = DetectTask(build_network(config, split.label_sizes_px, tmp_path), config, split, split, frozen_epochs=1)
    task.train()
    task.on_train_epoch_start()
    learning = {name for name, p in task.network.named_parameters() if p.requires_grad}
    assert {name.split(".")[1] for name in learning if name.startswith("backbone.")} == {"attentions"}
    assert any(name.startswith("heads.") for name in learning)
    assert not task.network.backbone.units["B_11"].reduce.norm.training
    assert task.network.branches["4"][0].norm.training
    task.frozen_epochs = 0
    task.on_train_epoch_start()
    assert all(p.requires_grad for p in task.network.parameters())
    assert task.network.backbone.units["B_11"].reduce.norm.training


def test_long_gradients_are_shortened_and_short_ones_left_alone(split, tmp_path):
    config = DetectConfig(width=0.125, in_channels=1, gradient_clip=2.0)
    task = DetectTask(build_network(config, split.label_sizes_px, tmp_path), config, split, split, 0)
    parameters = list(task.network.parameters())
    random = torch.Generator().manual_seed(0)
    # A frozen weight has none.
    drawn = [torch.randn(p.shape, generator=random) for p in parameters[1:]]
    length = torch.cat([gradient.flatten() for gradient in drawn]).norm()
    for expected, factor in ((50.0, 2.0 / 50), (2.5, 2.0 / 2.5), (1.9, 1.0)):
        for p, gradient in zip(parameters[1:], drawn, strict=True):
            p.grad = gradient * (expected / length)
        given = [p.grad.clone() for p in parameters[1:]]
        task.configure_gradient_clipping(None)
        assert parameters[0].grad is None
        for p, gradient in zip(parameters[1:], given, strict=True):
            torch.testing.assert_close(p.grad, factor * gradient, rtol=0 if factor == 1 else 1e-4, atol=0)


@pytest.mark.slow
def test_a_few_frames_can_be_learned_by_heart(split, tmp_path):
    """The whole chain (assignment, loss, decoding, suppression, matching) agrees: else this cannot work."""
    config = DetectConfig(width=0.125, in_channels=1, strides=(4, 8, 16), attention="cbam_identity", batch_size=4)
    few = split.first(4)
    network = build_network(config, few.label_sizes_px, tmp_path).train()
    grey, targets = next(iter(evaluation_loader(few, config, network.anchors)))
    images = network_input(grey, config.in_channels)
    optimizer = torch.optim.AdamW(network.parameters(), 5e-3)
    for _ in range(60):
        box, confidence = detection_loss(network(images), targets, network.anchors, network.strides, config.loss)
        optimizer.zero_grad()
        (0.05 * box + confidence).backward()
        optimizer.step()
    # Batch statistics of the very batch, since the running ones lag behind after so few steps.
    boxes, scores = network.detect(images)
    found = detections_of(boxes, scores, config.evaluation)
    assert curve(match_detections(few, found, config)).ap_paper() > 0.6


def test_augmentation_settings_reach_the_task(split, tmp_path):
    config = DetectConfig(width=0.125, in_channels=1, augment=AugmentSettings(noise=0.0))
    task = DetectTask(build_network(config, split.label_sizes_px, tmp_path), config, split, split, 0)
    assert task.train_dataloader().dataset.settings.noise == 0.0
