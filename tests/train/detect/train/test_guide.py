"""The guidance of gates: its target by hand, and that it moves the masks."""

import numpy as np
import pytest
import torch

from perilune_shared.dataset.manifest import open_dataset
from perilune_train.detect.config import DetectConfig, LabelSettings, LossSettings
from perilune_train.detect.data.assign import Assignment
from perilune_train.detect.data.batches import training_loader
from perilune_train.detect.data.split import load_split
from perilune_train.detect.train.detect_run import build_network
from perilune_train.detect.train.guide import GUIDED, craterness, guide_loss
from perilune_train.detect.train.task import DetectTask
from perilune_train.explain.inputs import ground_truth_mask


def assigned(frames, boxes):
    """Targets of one scale in which every label is learned twice."""
    places = torch.zeros(4, 2 * len(frames), dtype=torch.long)
    places[0] = torch.tensor(frames).repeat(2)
    return [Assignment(places, torch.tensor(boxes, dtype=torch.float32).repeat(2, 1), torch.zeros(1, dtype=torch.bool))]


def test_the_target_is_that_of_the_papers_mask():
    circles = np.array([[20.0, 30.0, 10.0], [40.0, 34.0, 14.0], [5.0, 60.0, 3.0]])
    boxes = np.c_[circles[:, :2] - circles[:, 2:], circles[:, :2] + circles[:, 2:]]
    found = craterness(assigned([0, 0, 1], boxes), 3, 64, 64, 1)
    for frame, rows in enumerate(([0, 1], [2], [])):
        mask = ground_truth_mask(64, 64, circles[rows, :2], circles[rows, 2], (1.1, 1.2, 1.3, 1.4))
        np.testing.assert_allclose(found[frame, 0].numpy(), 1 - mask, atol=1e-6)


def test_the_loss_by_hand():
    targets = assigned([0], [[8.0, 8, 24, 24]])
    target = craterness(targets, 1, 32, 32, 1)
    pooled = [torch.nn.functional.avg_pool2d(target, k) for k in (1, 2, 4)]
    alike = dict(zip(GUIDED, pooled, strict=True))
    assert guide_loss(alike, targets, (32, 32)).item() == pytest.approx(0, abs=1e-4)
    opposite = {gate: 3 - 2 * mask for gate, mask in alike.items()}
    assert guide_loss(opposite, targets, (32, 32)).item() == pytest.approx(2, abs=1e-4)
    constant = {gate: torch.ones_like(mask) for gate, mask in alike.items()}
    assert guide_loss(constant, targets, (32, 32)).item() == pytest.approx(1)


def test_guided_steps_make_the_masks_follow_craters(dataset_detect, tmp_path):
    split = load_split(open_dataset(dataset_detect), "train", LabelSettings())
    loss = LossSettings(lambda_guide=5.0)
    config = DetectConfig(
        width=0.125, in_channels=1, strides=(4, 8, 16), attention="cbam_centred", batch_size=4, loss=loss
    )
    torch.manual_seed(0)
    task = DetectTask(build_network(config, split.label_sizes_px, tmp_path), config, split, split, 0)
    task.train()
    batch = task.transfer_batch_to_device(
        next(iter(training_loader(split, config, task.network.anchors))), torch.device("cpu"), 0
    )
    optimizer = torch.optim.AdamW(task.parameters(), lr=0.005)
    found = []
    task.log = lambda name, value, **_: found.append(value.item())
    task.log_dict = lambda *_, **__: None
    for _ in range(25):
        optimizer.zero_grad()
        task.training_step(batch, 0).backward()
        optimizer.step()
    assert found[-1] < 0.75 * found[0]


def test_guidance_has_no_effect_without_gates(dataset_detect, tmp_path):
    split = load_split(open_dataset(dataset_detect), "train", LabelSettings())
    losses = []
    for weight in (0.0, 5.0):
        config = DetectConfig(
            width=0.125,
            in_channels=1,
            strides=(4, 8, 16),
            attention="none",
            batch_size=2,
            loss=LossSettings(lambda_guide=weight),
        )
        torch.manual_seed(0)
        task = DetectTask(build_network(config, split.label_sizes_px, tmp_path), config, split, split, 0)
        task.log_dict = lambda *_, **__: None
        batch = next(iter(training_loader(split, config, task.network.anchors)))
        losses.append(task.training_step(task.transfer_batch_to_device(batch, torch.device("cpu"), 0), 0).item())
    assert losses[0] == losses[1]
