"""Multiply-adds, by hand."""

import pytest
import torch
from torch import nn

from perilune_train.models.attention import CBAM
from perilune_train.models.size import multiply_adds
from perilune_train.models.yolo import YOLOv3


@pytest.mark.parametrize(
    ("layer", "shape", "expected"),
    [
        (nn.Conv2d(3, 8, 3, padding=1), (1, 3, 10, 6), 10 * 6 * 8 * 3 * 9),
        (nn.Conv2d(3, 8, 3, stride=2, padding=1), (2, 3, 10, 6), 2 * 5 * 3 * 8 * 3 * 9),
        (nn.Conv2d(8, 8, 3, padding=1, groups=8), (1, 8, 4, 4), 16 * 8 * 9),
        (nn.Linear(7, 5), (3, 7), 3 * 7 * 5),
        (nn.BatchNorm2d(8), (1, 8, 4, 4), 0),
        # Two pooled vectors through 32 -> 4, their sum through 4 -> 32, then 2 channels through 7 x 7.
        (CBAM(32), (1, 32, 6, 6), 2 * 32 * 4 + 4 * 32 + 36 * 2 * 49),
    ],
)
def test_layers_by_hand(layer, shape, expected):
    assert multiply_adds(layer, shape) == expected


def test_the_papers_network():
    # Darknet's own count for YOLOv3 at 416 px is 65.86 BFLOPs, two for each multiply-add, with 80 classes:
    # 255 instead of our 15 outputs on 1024, 512 and 256 channels at 13, 26 and 52 px.
    classes = 240 * (1024 * 13**2 + 512 * 26**2 + 256 * 52**2)
    found = multiply_adds(YOLOv3(None, 3, 1.0, "none"), (1, 3, 416, 416))
    assert 2 * (found + classes) / 1e9 == pytest.approx(65.86, rel=0.005)


def test_the_network_stays_as_it_is():
    network = YOLOv3(None, 1, 0.125, "cbam").train()
    multiply_adds(network, (1, 1, 64, 64))
    assert network.training
    assert network(torch.zeros(1, 1, 64, 64))[0].device.type == "cpu"
