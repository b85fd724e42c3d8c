"""Weights in half precision and in 8 bits: what is kept, and files that are refused."""

import json

import pytest
import torch
from safetensors.torch import load_file, save_file

from perilune_shared.errors import UserError
from perilune_train.detect.inference.detector import load_detector
from perilune_train.models.yolo import YOLOv3
from perilune_train.training.half_weights import precision_of, write_bytewise, write_half
from perilune_train.training.runs import RunFolder, load_weights, save_weights

ARCHITECTURE = {"in_channels": 1, "width": 0.125, "attention": "cbam_identity", "strides": [4, 8, 16]}


@pytest.fixture
def network():
    torch.manual_seed(1)
    return YOLOv3(torch.rand(3, 3, 2) * 20 + 4, **ARCHITECTURE).eval()


def test_it_detects_nearly_the_same(network, tmp_path):
    save_weights(tmp_path / "best.ckpt", ARCHITECTURE, network, {"known": True, "uses": []})
    content = load_weights(tmp_path / "best.ckpt")
    write_half(tmp_path / "weights.safetensors", content)
    again = load_weights(tmp_path / "weights.safetensors")
    assert again["architecture"] == ARCHITECTURE and again["terrain"] == {"known": True, "uses": []}
    images = torch.randn(2, 1, 64, 64)
    boxes, scores = network.detect(images)
    found_boxes, found_scores = load_detector(tmp_path / "weights.safetensors").detect(images)
    assert float((boxes - found_boxes).abs().max()) < 0.05 and float((scores - found_scores).abs().max()) < 1e-3
    assert not torch.equal(boxes, found_boxes), "half precision rounds"
    sizes = [(tmp_path / name).stat().st_size for name in ("best.ckpt", "weights.safetensors")]
    assert 0.45 < sizes[1] / sizes[0] < 0.6


@pytest.mark.parametrize("write", [write_half, write_bytewise])
def test_vectors_and_buffers_keep_their_precision(network, tmp_path, write):
    content = {"architecture": ARCHITECTURE, "state_dict": network.state_dict()}
    write(tmp_path / "weights.safetensors", content)
    again = load_weights(tmp_path / "weights.safetensors")["state_dict"]
    exact = [key for key in again if key == "anchors" or "running" in key or key.endswith("bias")]
    assert len(exact) > 100 and all(torch.equal(network.state_dict()[key], again[key]) for key in exact)
    assert all(again[key].dtype == value.dtype for key, value in network.state_dict().items())


@pytest.mark.parametrize("write, bytes_per_weight", [(write_half, 2), (write_bytewise, 1)])
def test_matrices_of_an_lstm_are_rounded_too(tmp_path, write, bytes_per_weight):
    lstm = torch.nn.Module()
    lstm.recurrent = torch.nn.LSTM(32, 64, num_layers=2)
    state = lstm.state_dict()
    write(tmp_path / "weights.safetensors", {"architecture": ARCHITECTURE, "state_dict": state})
    stored = load_file(tmp_path / "weights.safetensors")
    matrices = [key for key, value in state.items() if value.ndim == 2]
    assert len(matrices) == 4 and all(stored[key].element_size() == bytes_per_weight for key in matrices)
    assert all(torch.equal(stored[key], state[key]) for key in state if key not in matrices)
    again = load_weights(tmp_path / "weights.safetensors")["state_dict"]
    assert all(torch.allclose(again[key], state[key], atol=0.001) for key in state)


def test_a_folder_with_weights_is_a_run(tmp_path):
    assert RunFolder(tmp_path).best.name == "best.ckpt"
    (tmp_path / "weights.safetensors").write_bytes(b"")
    assert RunFolder(tmp_path).best.name == "weights.safetensors"


def test_weights_out_of_range_are_refused(network, tmp_path):
    state = network.state_dict()
    name = next(key for key, value in state.items() if value.ndim == 4)
    state[name] = state[name] + 1e6
    with pytest.raises(UserError, match="65504"):
        write_half(tmp_path / "weights.safetensors", {"architecture": ARCHITECTURE, "state_dict": state})
    assert list(tmp_path.iterdir()) == []


def test_eight_bits_round_by_half_a_step_of_each_channel(network, tmp_path):
    state = network.state_dict()
    name = next(key for key, value in state.items() if value.ndim == 4)
    state[name][0] = 0
    state[name][1] *= 1000
    half, bytewise = tmp_path / "half.safetensors", tmp_path / "weights.safetensors"
    content = {"architecture": ARCHITECTURE, "state_dict": state, "terrain": {"known": True, "uses": []}}
    write_half(half, content)
    write_bytewise(bytewise, content)
    assert [precision_of(path) for path in (half, bytewise)] == ["half precision", "8 bits per weight"]
    again = load_weights(bytewise)
    assert {key: again[key] for key in ("architecture", "terrain")} == {
        key: load_weights(half)[key] for key in again if key != "state_dict"
    }
    rounded = [key for key, value in state.items() if key.endswith(".weight") and value.ndim >= 2]
    assert set(again["state_dict"]) == set(state)
    for key in rounded:
        flat, found = state[key].flatten(1), again["state_dict"][key].flatten(1)
        step = flat.abs().amax(1, keepdim=True) / 127
        assert bool(((flat - found).abs() <= 0.5001 * step).all()), key
    assert not bool(again["state_dict"][name][0].any())
    assert bytewise.stat().st_size < 0.75 * half.stat().st_size


@pytest.mark.parametrize("damage", ["no steps", "no integers", "steps of half precision", "too few steps"])
def test_integers_whose_steps_do_not_fit_are_refused(network, tmp_path, damage):
    path = tmp_path / "weights.safetensors"
    write_bytewise(path, {"architecture": ARCHITECTURE, "state_dict": network.state_dict()})
    tensors = load_file(path)
    name = next(key for key, value in tensors.items() if value.dtype == torch.int8)
    if damage == "no steps":
        del tensors[f"{name}#step"]
    elif damage == "no integers":
        del tensors[name]
    elif damage == "too few steps":
        tensors[f"{name}#step"] = tensors[f"{name}#step"][1:].contiguous()
    else:
        tensors[f"{name}#step"] = tensors[f"{name}#step"].half()
    save_file(tensors, path, {"architecture": json.dumps(ARCHITECTURE)})
    with pytest.raises(UserError, match=f"{name}: got"):
        load_weights(path)


@pytest.mark.parametrize("damage", ["truncated", "text", "no architecture", "not JSON", "missing"])
def test_other_files_are_refused(network, tmp_path, damage):
    path = tmp_path / "weights.safetensors"
    if damage == "truncated":
        write_half(path, {"architecture": ARCHITECTURE, "state_dict": network.state_dict()})
        path.write_bytes(path.read_bytes()[:5000])
    elif damage == "text":
        path.write_text("no weights")
    elif damage != "missing":
        tensors = {key: value.contiguous() for key, value in network.state_dict().items()}
        save_file(tensors, path, {"architecture": "[" * 9999 if damage == "not JSON" else json.dumps([1])})
    with pytest.raises(UserError, match=r"weights\.safetensors"):
        load_detector(path)
