"""Darknet's weight files, against a reading written by hand from the published order."""

import os
import struct

import numpy as np
import pytest
import torch
from tests.helpers import darknet_by_hand as by_hand

from perilune_shared.errors import UserError
from perilune_train.models.darknet import AttentionDarknet53
from perilune_train.models.darknet_weights import (
    COCO_FILTERS,
    backbone_slots,
    content_of,
    count_floats,
    fill_slots,
    is_darknet,
    network_slots,
    read_darknet,
    write_darknet,
)
from perilune_train.models.yolo import YOLOv3

WIDTH = 0.25
HEADERS = {
    "0.1.0": (struct.pack("<4i", 0, 1, 0, 64), 16),
    "0.2.0": (struct.pack("<3iQ", 0, 2, 0, 1 << 40), 20),
    "0.2.5": (struct.pack("<3iQ", 0, 2, 5, 7), 20),
    "1.0.0": (struct.pack("<3iQ", 1, 0, 0, 7), 20),
    "1000.2.0": (struct.pack("<4i", 1000, 2, 0, 7), 16),
    "0.1000.0": (struct.pack("<4i", 0, 1000, 0, 7), 16),
}


@pytest.fixture(scope="module")
def values():
    return by_hand.random_values(by_hand.cfg(backbone_only=True), WIDTH, 0)


@pytest.fixture
def backbone():
    torch.manual_seed(0)
    return AttentionDarknet53(3, WIDTH).eval()


def test_sizes_of_the_published_files():
    with torch.device("meta"):
        network = YOLOv3()
    assert count_floats(backbone_slots(network.backbone)) == 40_620_640
    assert count_floats(network_slots(network, COCO_FILTERS)) == 62_001_757
    assert 4 * 62_001_757 + len(by_hand.HEADER) == 248_007_048
    convolutions = {slot.name.rsplit(" ", 1)[0] for slot in network_slots(network)}
    assert len(convolutions) == 75
    assert len({slot.name.rsplit(" ", 1)[0] for slot in backbone_slots(network.backbone)}) == 52
    counted = [o * i * k * k + (4 if norm else 1) * o for o, i, k, norm in by_hand.shapes(by_hand.cfg(), 1.0)]
    assert len(counted) == 75 and sum(counted) == 62_001_757


def test_a_whole_network_is_what_the_cfg_makes_of_the_file(tmp_path):
    """Order of the convolutions, of the tensors in each, and of what the neck joins: all show in the outputs."""
    layers = by_hand.cfg(filters=15)
    raw = by_hand.HEADER + by_hand.random_values(layers, WIDTH, 1).tobytes()
    path = tmp_path / "a.weights"
    path.write_bytes(raw)
    network = YOLOv3(None, 3, WIDTH).eval()
    slots = network_slots(network)
    fill_slots(slots, read_darknet(path, (count_floats(slots),)), path)
    image = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        ours = network(image)
        out = by_hand.run(layers, raw, image, WIDTH)
    theirs = [x for x, layer in zip(out, layers, strict=True) if layer[0] == "yolo"]
    for one, other in zip(ours, reversed(theirs), strict=True):
        other = other.unflatten(1, (3, 5)).permute(0, 1, 3, 4, 2)
        assert other.abs().mean() > 0.05
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-3 * float(other.abs().max()))
    content = content_of(slots)
    assert content.values.tobytes() == raw[20:]
    assert content.header == struct.pack("<3iQ", 0, 2, 0, 0)


@pytest.mark.parametrize("name", HEADERS)
def test_headers_are_kept_byte_for_byte(tmp_path, backbone, values, name):
    header, length = HEADERS[name]
    assert len(header) == length
    path, again = tmp_path / "a.conv.74", tmp_path / "b.conv.74"
    path.write_bytes(header + values.tobytes())
    content = read_darknet(path, (len(values),))
    fill_slots(backbone_slots(backbone), content, path)
    assert content.header == header
    write_darknet(again, content)
    assert again.read_bytes() == path.read_bytes()
    assert content_of(backbone_slots(backbone)).values.tobytes() == values.tobytes()


@pytest.mark.parametrize(
    ("size", "found"),
    [
        (0, "0 bytes: an incomplete header"),
        (11, "11 bytes: an incomplete header"),
        (15, "15 bytes: an incomplete header"),
        (19, "19 bytes: an incomplete header"),
        (20, "20 bytes: a header and 0 floats"),
        (-1, "floats and 3 bytes"),
        (-4, "floats"),
        (1, "floats and 1 bytes"),
        (4, "floats"),
    ],
)
@pytest.mark.parametrize("n_floats", [40_620_640, 62_001_757])
def test_a_file_of_another_size_is_refused_by_name(tmp_path, size, found, n_floats):
    path = tmp_path / "x.weights"
    path.write_bytes(by_hand.HEADER)
    os.truncate(path, size if size in (0, 11, 15, 19, 20) else 20 + 4 * n_floats + size)
    with pytest.raises(UserError) as caught:
        read_darknet(path, (40_620_640, 62_001_757))
    message = str(caught.value)
    assert message.startswith(f"{path}: size: got ") and found in message and "\n" not in message
    assert message.endswith("expected 40620640 or 62001757 floats")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused(tmp_path, values, bad):
    path = tmp_path / "x.weights"
    spoilt = values.copy()
    spoilt[1234] = bad
    path.write_bytes(by_hand.HEADER + spoilt.tobytes())
    with pytest.raises(UserError, match=f"x.weights: float 1234: got {bad}, expected finite numbers"):
        read_darknet(path, (len(values),))


def test_a_negative_variance_is_refused_and_nothing_is_loaded(tmp_path, backbone, values):
    before = {key: value.clone() for key, value in backbone.state_dict().items()}
    spoilt = values.copy()
    slots = backbone_slots(backbone)
    at = [slot.name for slot in slots].index("convolution 51 variance")
    spoilt[count_floats(slots[:at])] = -0.5
    path = tmp_path / "x.weights"
    path.write_bytes(by_hand.HEADER + spoilt.tobytes())
    with pytest.raises(UserError, match=r"x.weights: convolution 51 variance: got -0.5"):
        fill_slots(slots, read_darknet(path, (len(values),)), path)
    assert all(torch.equal(value, before[key]) for key, value in backbone.state_dict().items())


def test_a_negative_version_and_a_missing_file_are_refused(tmp_path):
    path = tmp_path / "x.weights"
    path.write_bytes(struct.pack("<3iQ", 0, -2, 0, 0))
    with pytest.raises(UserError, match=r"version: got 0.-2.0"):
        read_darknet(path, (1,))
    with pytest.raises(UserError, match=r"absent.weights: weights: got no such file"):
        read_darknet(tmp_path / "absent.weights", (1,))


def test_a_file_is_known_by_content_then_by_name(tmp_path):
    def kind(name, content):
        tmp_path.joinpath(name).write_bytes(content)
        return is_darknet(tmp_path / name)

    assert kind("backbone.bin", by_hand.HEADER)
    assert kind("a.weights", b"")
    assert kind("a.conv.74", b"no header")
    assert not kind("a.ckpt", b"")
    assert not kind("text.txt", b"a plain text file")
    torch.save({}, tmp_path / "b.weights")
    assert not is_darknet(tmp_path / "b.weights")
    assert is_darknet(tmp_path / "absent.weights")
    assert not is_darknet(tmp_path / "absent.ckpt")


def test_other_strides_have_no_such_file():
    with torch.device("meta"), pytest.raises(ValueError, match=r"strides are \(4, 8, 16\)"):
        network_slots(YOLOv3(strides=(4, 8, 16)))


@pytest.mark.slow
def test_identity_gates_keep_a_pretrained_backbones_features(tmp_path):
    """Of a full backbone: cosine to plain Darknet53 at least 0.999 at every stage. CBAM's plain form falls short."""
    path = tmp_path / "darknet53.conv.74"
    path.write_bytes(by_hand.HEADER + by_hand.random_values(by_hand.cfg(backbone_only=True), 1.0, 2).tobytes())
    content = read_darknet(path, (40_620_640,))
    path.unlink()
    image = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    features = {}
    for attention in ("none", "cbam_identity", "cbam"):
        torch.manual_seed(0)
        network = AttentionDarknet53(attention=attention).eval()
        fill_slots(backbone_slots(network), content, path)
        with torch.no_grad():
            features[attention] = network(image)
    cosines = {
        attention: [
            torch.cosine_similarity(a.flatten(), b.flatten(), dim=0).item()
            for a, b in zip(features["none"], features[attention], strict=True)
        ]
        for attention in ("cbam_identity", "cbam")
    }
    assert len(cosines["cbam_identity"]) == 5 and min(cosines["cbam_identity"]) >= 0.999
    assert min(cosines["cbam"]) < 0.9
