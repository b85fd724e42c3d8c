"""Hostile checkpoints, weights, Darknet and ONNX files: each is refused in one line, with little memory and time."""

import functools
import io
import json
import os
import pickle
import struct
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path

import pytest
import safetensors.torch
import torch

from perilune_shared.console.command_line import run_command_line
from perilune_shared.errors import UserError
from perilune_train.cli.main import main
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.inference import detector
from perilune_train.detect.train import transfer
from perilune_train.models import darknet_weights
from perilune_train.models.yolo import YOLOv3
from perilune_train.motion.network import build
from perilune_train.training.runs import read_saved, save_weights
from tests.hostile.measured import Outcome, refused

# The commands import these only when they need them; imports would count as memory.
IMPORTED = (DetectConfig, detector, transfer, darknet_weights)
DETECTOR = {"in_channels": 1, "width": 0.125, "attention": "none", "strides": [8, 16, 32]}
SCALES = {"mean_m": [0.0] * 3, "spread_m": [1.0] * 3, "rotation_rad": 0.01}
NAVIGATOR = {
    "fusion": "warp", "size_px": 64, "in_channels": 8, "width": 0.125, "attention": "none", "hidden": 8,
    "focal_over_width": 1.1, "scales": SCALES,
}  # fmt: skip
STACK = NAVIGATOR | {"fusion": "stack", "in_channels": 1}
HUGE = 10**12


@functools.cache
def state(kind: str = "detector") -> dict:
    """Weights of a small network."""
    torch.manual_seed(0)
    if kind == "detector":
        return dict(YOLOv3(torch.ones(3, 3, 2), **DETECTOR).state_dict())
    return dict(build(NAVIGATOR if kind == "warp" else STACK).state_dict())


def elliptic(numbers: int, value: float | None = None) -> dict:
    """Weights of a detector of ellipses whose last layers have `numbers` outputs, all `value` if it is given."""
    weights = dict(YOLOv3(torch.ones(3, 3, 2), **DETECTOR | {"ellipses": True}).state_dict())
    for key, old in weights.items():
        if key.startswith("ellipse_tower.output."):
            weights[key] = old[:numbers].clone() if value is None else torch.full_like(old[:numbers], value)
    return weights


def saved(architecture: object = DETECTOR, weights: object = None, **more: object) -> bytes:
    content = io.BytesIO()
    torch.save({"architecture": architecture, "state_dict": state() if weights is None else weights, **more}, content)
    return content.getvalue()


def rewritten(content: bytes, change: Callable[[dict[str, bytes]], dict[str, bytes]], method: int = 0) -> bytes:
    """A checkpoint whose files are changed, and compressed by a method of `zipfile`."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        files = {entry.filename: archive.read(entry) for entry in archive.infolist()}
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive:
        for name, part in change(files).items():
            archive.writestr(name, part)
    return out.getvalue()


def with_pickle(pickled: bytes) -> bytes:
    return rewritten(saved(weights={}), lambda files: files | {"archive/data.pkl": pickled})


class Calls:
    """Pickles as a call of a function."""

    def __init__(self, function: object, *arguments: object):
        self.function, self.arguments = function, arguments

    def __reduce__(self) -> tuple:
        return self.function, self.arguments


def calling(function: object, *arguments: object) -> bytes:
    return with_pickle(pickle.dumps({"architecture": DETECTOR, "state_dict": Calls(function, *arguments)}, 2))


def changed_tensor(name: str, value: float) -> dict:
    weights = dict(state())
    weights[name] = weights[name].clone()
    weights[name].view(-1)[0] = value
    return weights


def nested(depth: int) -> list:
    """Each list has the list before it ten times: 10^depth values in a few bytes."""
    value: list = []
    for _ in range(depth):
        value = [value] * 10
    return value


def deep(depth: int) -> list:
    value: list = []
    for _ in range(depth):
        value = [value]
    return value


def overlapping() -> bytes:
    """A list of 1,500 files that are all the same megabyte."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("archive/data.pkl", b"x" * 1_000_000)
        first = archive.infolist()[0]
        for number in range(1500):
            entry = zipfile.ZipInfo(f"archive/data/{number}")
            entry.file_size = entry.compress_size = first.file_size
            entry.CRC, entry.header_offset = first.CRC, first.header_offset
            archive.filelist.append(entry)
            archive.NameToInfo[entry.filename] = entry
    return out.getvalue()


def many_files() -> bytes:
    """A list of 400,000 empty files."""
    one = struct.pack("<4s4B4HL2L5H2L", b"PK\1\2", 20, 0, 20, 0, 0, 0, 0, 0x21, 0, 0, 0, 8, 0, 0, 0, 0, 0, 0)
    entries = b"".join(one + f"a/{number:06d}".encode() for number in range(400_000))
    return entries + struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 0xFFFF, 0xFFFF, len(entries), 0, 0)


def ones(*shape: int) -> torch.Tensor:
    return torch.zeros(1).expand(*shape)


CHECKPOINTS: dict[str, tuple[Callable[[], bytes], str]] = {
    "nothing": (lambda: b"", "not a checkpoint"),
    "text": (lambda: b"not a checkpoint" * 100, "not a checkpoint"),
    "first half": (lambda: saved()[: len(saved()) // 2], "not a checkpoint"),
    "old format": (lambda: pickle.dumps({"architecture": DETECTOR}), "not a checkpoint"),
    "runs a command": (lambda: calling(os.system, "touch executed"), "a file that calls posix.system"),
    "calls eval": (lambda: calling(eval, "1"), "a file that calls __builtin__.eval"),
    "name with escape codes": (
        lambda: with_pickle(b"\x80\x02c\x1b[31mos\n\x1b]0;system\x07\n."),
        "a file that calls ?[31mos.?]0;system?",
    ),
    "a bytearray of 16 GB": (lambda: calling(bytearray, 2**34), "a file that calls __builtin__.bytearray"),
    "bytes of protocol 5": (lambda: with_pickle(b"\x80\x05\x96" + struct.pack("<Q", 2**34) + b"."), "damaged"),
    "a sparse tensor": (
        lambda: saved(weights={"a": torch.sparse_coo_tensor([[0]], [1.0], (10,))}),
        "a file that calls torch._utils._rebuild_sparse_tensor",
    ),
    "a meta tensor of terabytes": (
        lambda: saved(weights={"a": torch.empty(HUGE, device="meta")}),
        "a file that calls torch._utils._rebuild_meta_tensor_no_storage",
    ),
    "place of a value beyond memory": (lambda: with_pickle(b"\x80\x02]r\xff\xff\xff\x7f."), "no architecture"),
    "an expanded tensor": (lambda: saved(weights={"a": ones(HUGE)}), "in a storage of 1 numbers"),
    "an expanded tensor of the right name": (
        lambda: saved(weights=state() | {"anchors": ones(3, 3, 2)}),
        "in a storage of 1 numbers",
    ),
    "storage larger than its file": (
        lambda: rewritten(saved(), lambda files: files | {"archive/data/0": b""}),
        "numbers (FloatStorage) in 0 bytes",
    ),
    "compressed": (lambda: rewritten(saved(), lambda files: files, zipfile.ZIP_DEFLATED), "a compressed ZIP"),
    "1 MB that inflates to 1.5 GB": (
        lambda: rewritten(
            saved(weights={}), lambda files: files | {"archive/data/0": bytes(300_000_000)}, zipfile.ZIP_DEFLATED
        ),
        "a compressed ZIP",
    ),
    "overlapping files": (overlapping, "a ZIP whose files overlap"),
    "many files": (many_files, "a directory of"),
    "a pickle of 5 MB": (lambda: with_pickle(b"\x80\x02" + b"}" * 5_000_000), "a pickle of 5000002 bytes"),
    "a pickle of 4 MB": (lambda: with_pickle(b"\x80\x02" + b"}" * 3_900_000), "damaged"),
    "10^12 values": (lambda: saved(nested(12)), "more values, text or nesting"),
    "deep nesting": (lambda: saved(deep(300)), "more values, text or nesting"),
    "integers of equal hashes": (
        lambda: saved({k * (2**61 - 1): 0 for k in range(1, 50)}),
        "an integer of more than 64 bits",
    ),
    "attributes of a dictionary": (
        lambda: with_pickle(b"\x80\x02ccollections\nOrderedDict\n)R}X\x04\0\0\0keysK\x01sb."),
        "an object with attributes",
    ),
    "no dictionary": (lambda: with_pickle(pickle.dumps([1], 2)), "no architecture, state_dict"),
    "architecture is a number": (lambda: saved(3), "architecture: got int"),
    "weights are a list": (lambda: saved(weights=[1]), "weights: got list"),
    "a weight is text": (lambda: saved(weights=state() | {"anchors": "a"}), "weights.anchors: got str"),
    "architecture of another kind": (lambda: saved({"hidden": 3}), "a detect run's checkpoint"),
    "width of 10^9": (lambda: saved(DETECTOR | {"width": 1e9}), "architecture.width: got 1000000000.0, expected at"),
    "width is NaN": (lambda: saved(DETECTOR | {"width": float("nan")}), "architecture.width"),
    "width is text": (lambda: saved(DETECTOR | {"width": "1"}), "architecture.width"),
    "channels of 10^12": (lambda: saved(DETECTOR | {"in_channels": HUGE}), "architecture.in_channels"),
    "strides of nothing": (lambda: saved(DETECTOR | {"strides": []}), "architecture.strides"),
    "strides of 2": (lambda: saved(DETECTOR | {"strides": [2, 4, 8]}), "strides [8, 16, 32] or [4, 8, 16]"),
    "ellipses are text": (lambda: saved(DETECTOR | {"ellipses": "\x1b[31myes"}), "architecture.ellipses"),
    "ellipses of 2": (lambda: saved(DETECTOR | {"ellipses": 2}), "architecture.ellipses"),
    "ellipses without weights": (lambda: saved(DETECTOR | {"ellipses": True}), "ellipse_tower"),
    "weights of ellipses without the setting": (
        lambda: saved(weights=state() | {"ellipse_tower.output.8.bias": torch.zeros(15)}),
        "ellipse_tower.output.8.bias: got (15,), expected no such tensor",
    ),
    "weights of other ellipses": (
        lambda: saved(DETECTOR | {"ellipses": True}, elliptic(5)),
        "ellipse_tower.output.16.bias: got (5,), expected (15,)",
    ),
    "deviations that are NaN": (
        lambda: saved(DETECTOR | {"ellipses": True}, elliptic(15, float("nan"))),
        "numbers are not finite",
    ),
    "no ellipses in a setting of the wrong name": (
        lambda: saved(DETECTOR | {"elipses": False}),
        "a detect run's checkpoint",
    ),
    "unknown attention": (lambda: saved(DETECTOR | {"attention": "\x1b[31mred"}), "architecture.attention"),
    "a network of 1 GB in 2 kB": (lambda: saved(DETECTOR | {"width": 2.0}, {}), "another architecture"),
    "weights of another width": (lambda: saved(DETECTOR | {"width": 0.25}), "another architecture"),
    "NaN": (lambda: saved(weights=changed_tensor("anchors", float("nan"))), "1 of 18 numbers are not finite"),
    "infinity": (lambda: saved(weights=changed_tensor("backbone.stem.conv.weight", float("inf"))), "not finite"),
    "negative variance": (
        lambda: saved(weights=changed_tensor("backbone.stem.norm.running_var", -1.0)),
        "a variance of at least 0",
    ),
    "complex weights": (
        lambda: saved(weights=state() | {"anchors": torch.ones(3, 3, 2, dtype=torch.complex64)}),
        "a file that calls torch.ComplexFloatStorage",
    ),
}


def convert(name: str, path: Path, naming: str) -> Outcome:
    return refused(
        name, main, "detect", "weights", path, "--out", path.with_name("a.weights"), naming=naming, memory_mb=450
    )


@pytest.mark.parametrize("name", CHECKPOINTS)
def test_checkpoints(name: str, tmp_path: Path) -> None:
    make, naming = CHECKPOINTS[name]
    path = tmp_path / "best.ckpt"
    path.write_bytes(make())
    ended = convert(name, path, naming)
    assert ended.seconds < 30
    assert sorted(each.name for each in tmp_path.iterdir()) == ["best.ckpt"] and not Path("executed").exists()


def header(text: bytes, length: int | None = None) -> bytes:
    return struct.pack("<Q", len(text) if length is None else length) + text


def half(architecture: object = DETECTOR, weights: dict | None = None) -> bytes:
    tensors = {name: tensor.contiguous() for name, tensor in (state() if weights is None else weights).items()}
    return safetensors.torch.save(tensors, {"architecture": json.dumps(architecture)})


SAFETENSORS: dict[str, tuple[Callable[[], bytes], str]] = {
    "nothing": (lambda: b"", "weights"),
    "first half": (lambda: half()[: len(half()) // 2], "weights"),
    "a header of exabytes": (lambda: header(b"{}", 2**62), "a header of"),
    "a header of 90 MB": (lambda: header(b"[" * 90_000_000), "a header of 90000000 bytes"),
    "deep JSON": (lambda: header(b'{"a":' + b"[" * 5_000_000), "weights"),
    "a tensor of terabytes": (
        lambda: header(b'{"a":{"dtype":"F32","shape":[1000000000000],"data_offsets":[0,4000000000000]}}'),
        "weights",
    ),
    "no numbers": (lambda: header(b'{"a":{"dtype":"F32","shape":[0,4611686018427387904],"data_offsets":[0,0]}}'), ""),
    "no architecture": (lambda: safetensors.torch.save(state()), "architecture: got missing"),
    "architecture is a list": (lambda: half([1]), "architecture: got missing"),
    "width of 10^9": (lambda: half(DETECTOR | {"width": 1e9}), "architecture.width"),
    "width is NaN": (lambda: half(DETECTOR | {"width": float("nan")}), "architecture.width"),
    "NaN": (lambda: half(weights=changed_tensor("anchors", float("nan"))), "1 of 18 numbers are not finite"),
    "another type": (
        lambda: half(weights=state() | {"anchors": torch.ones(3, 3, 2).to(torch.float8_e5m2)}),
        "numbers of type F8_E5M2",
    ),
    "a network of 1 GB": (lambda: half(DETECTOR | {"width": 2.0}, {}), "another architecture"),
}


@pytest.mark.parametrize("name", SAFETENSORS)
def test_safetensors(name: str, tmp_path: Path) -> None:
    make, naming = SAFETENSORS[name]
    path = tmp_path / "w.safetensors"
    path.write_bytes(make())
    convert(f"{name}, safetensors", path, naming)


NAVIGATORS: dict[str, tuple[dict, str]] = {
    "hidden size of 10^9": ({"hidden": 10**9}, "architecture.hidden"),
    "width of 10^6": ({"width": 1e6}, "architecture.width"),
    "frames of 10^9 pixels": ({"size_px": 32 * 10**8}, "architecture.size_px"),
    "no scales": ({"scales": {}}, "architecture.scales.mean_m"),
    "infinite scales": ({"scales": SCALES | {"spread_m": [float("inf")] * 3}}, "architecture.scales.spread_m"),
    "scales of 0": ({"scales": SCALES | {"spread_m": [0.0] * 3}}, "architecture.scales.spread_m"),
    "no focal length": ({"focal_over_width": 0.0}, "architecture.focal_over_width"),
    "pool of 10^6": ({"fusion": "stack", "pool": 10**6}, "architecture.pool"),
    "another network": ({"fusion": ["warp"]}, "a navigate run's checkpoint"),
    "a network of 1 GB": ({"width": 2.0, "hidden": 4096}, "another architecture"),
}


@pytest.mark.parametrize("name", NAVIGATORS)
def test_navigators(name: str, tmp_path: Path) -> None:
    """Through the export, which opens a run's navigator."""
    from perilune_train.motion.deploy import export

    assert export
    changes, naming = NAVIGATORS[name]
    path = tmp_path / "run" / "checkpoints" / "best.ckpt"
    path.parent.mkdir(parents=True)
    path.write_bytes(saved(NAVIGATOR | changes, state("warp")))
    arguments = ("navigate", "deploy", "--run", tmp_path / "run", "--out", tmp_path / "out")
    refused(f"{name}, navigator", main, *arguments, naming=naming, memory_mb=450)
    assert not (tmp_path / "out").exists()


DARKNET: dict[str, tuple[Callable[[], bytes], str]] = {
    "nothing": (lambda: b"", "an incomplete header"),
    "a header": (lambda: struct.pack("<3iQ", 0, 2, 0, 0), "a header and 0 floats"),
    "negative version": (lambda: struct.pack("<3iQ", -1, 2, 0, 0), "a Darknet file's header"),
    "NaN": (lambda: struct.pack("<3iQ", 0, 2, 0, 0) + b"\xff" * 4 * 40_620_640, "finite numbers"),
    "variance below 0": (
        lambda: struct.pack("<3iQ", 0, 2, 0, 0) + struct.pack("<f", -1.0) * 40_620_640,
        "a variance of at least 0",
    ),
}


@pytest.mark.parametrize("name", DARKNET)
def test_darknet(name: str, tmp_path: Path) -> None:
    make, naming = DARKNET[name]
    path = tmp_path / "darknet53.conv.74"
    path.write_bytes(make())
    refused(f"{name}, Darknet", functools.partial(started_from, path), naming=naming, memory_mb=900)


def started_from(path: Path) -> None:
    """Check a file for `detect.init_from`, and end as a command does."""
    run_command_line(lambda: transfer.check_start(path))


@pytest.mark.parametrize("where", ["initializer", "attribute", "subgraph"])
@pytest.mark.parametrize("engine", ["onnxruntime_engine", "openvino_engine"])
def test_an_onnx_file_that_names_other_files(where: str, engine: str, tmp_path: Path) -> None:
    """Else a tensor could be the bytes of any file, such as a key."""
    onnx = pytest.importorskip("onnx", reason="the extra `export` is not installed")
    from perilune_train.detect.deploy import engines

    (tmp_path / "secret").write_bytes(bytes(16))
    tensor = onnx.TensorProto(name="w", dims=[4], data_type=1, data_location=onnx.TensorProto.EXTERNAL)
    for key, value in (("location", "../secret"), ("offset", "0"), ("length", "16")):
        entry = tensor.external_data.add()
        entry.key, entry.value = key, value
    images, out = (onnx.helper.make_tensor_value_info(name, 1, [4]) for name in ("images", "boxes"))
    graph = onnx.helper.make_graph([onnx.helper.make_node("Add", ["images", "w"], ["boxes"])], "g", [images], [out])
    constant = onnx.helper.make_node("Constant", [], ["w"], value=tensor)
    if where == "initializer":
        graph.initializer.append(tensor)
    elif where == "attribute":
        graph.node.insert(0, constant)
    else:
        inner = onnx.helper.make_graph([constant], "inner", [], [out])
        graph.node.append(onnx.helper.make_node("If", ["images"], ["x"], then_branch=inner, else_branch=inner))
    path = tmp_path / "folder" / "a.onnx"
    path.parent.mkdir()
    path.write_bytes(onnx.helper.make_model(graph).SerializeToString())
    with pytest.raises(UserError, match=r"a tensor in the file '\.\./secret'"):
        getattr(engines, engine)(path)


def test_a_last_state_of_another_hand(tmp_path: Path) -> None:
    """`.ckpt` is for one's own runs, but a state that calls a function is not opened either."""
    path = tmp_path / "last.ckpt"
    path.write_bytes(calling(os.system, "touch executed"))
    with pytest.raises(UserError, match=r"a file that calls posix\.system"):
        read_saved(path, "last state", {"state_dict"}, "the state of a run")


def test_good_weights_pass(tmp_path: Path) -> None:
    """The refusals above are not refusals of everything."""
    torch.manual_seed(0)
    network = YOLOv3(torch.ones(3, 3, 2), 3, 0.125, "cbam", (8, 16, 32))
    architecture = {"in_channels": 3, "width": 0.125, "attention": "cbam", "strides": [8, 16, 32]}
    save_weights(tmp_path / "best.ckpt", architecture, network, {"known": True, "uses": []})
    loaded = detector.load_detector(tmp_path / "best.ckpt")
    assert all(torch.equal(value, loaded.state_dict()[name]) for name, value in network.state_dict().items())
    assert isinstance(network.state_dict(), OrderedDict)
    # Weights that state no `ellipses`, as of 0.1.0, have none; others say that they have them.
    assert not loaded.ellipses and loaded.detect_ellipses(torch.zeros(1, 3, 32, 32))[2] is None
    content = saved(DETECTOR | {"ellipses": True}, elliptic(15))
    (tmp_path / "ellipses.ckpt").write_bytes(content)
    assert detector.load_detector(tmp_path / "ellipses.ckpt").ellipses
