"""Inference engines: functions that map images to boxes, scores and, if the network predicts ellipses, shapes."""

import contextlib
import functools
import importlib
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from perilune_shared.errors import UserError
from perilune_shared.threads import cores_in_affinity, usable_cores
from perilune_train.training.checkpoint_file import MAX_WEIGHT_BYTES

Array = NDArray[np.float32]
Engine = Callable[[Array], tuple[Array, ...]]
"""Maps normalised images (N, C, H, W), float32, to the outputs of `YOLOv3.detect_ellipses`: boxes (N, K, 4) in pixels,
scores (N, K) and, if the network predicts ellipses, shapes (N, K, 5)."""
OUTPUT_NAMES = ("boxes", "scores", "shapes")
"""Outputs of a file. `shapes` is missing if the network predicts no ellipses."""
EnginePrecision = Literal["f32", "bf16"]
_EXPECTED = "a file written by `perilune-train detect deploy`"


def package(name: str) -> Any:
    """Import a module of the extra `export`. Raises UserError if it is not installed."""
    # Official builds of ONNX Runtime send telemetry unless this is set before the import.
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    # OpenVINO reports each import to an analytics service, and stores a user id for it in the home folder. It does
    # neither if the package openvino_telemetry is missing, so hide it, unless the program has already imported it.
    sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]
    try:
        return importlib.import_module(name)
    except ImportError:
        raise UserError("perilune-train", name, "not installed", "pip install 'perilune-train[export]'") from None


def torch_engine(network: nn.Module, precision: EnginePrecision = "f32") -> Engine:
    """Engine of a torch network that returns boxes, scores and perhaps shapes, with torch's number of threads."""
    network = network.to(memory_format=torch.channels_last).eval()  # type: ignore[call-overload]

    @torch.inference_mode()
    def run(images: Array) -> tuple[Array, ...]:
        inputs = torch.as_tensor(images).contiguous(memory_format=torch.channels_last)
        with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16"):
            outputs = network(inputs)
        return tuple(part.float().numpy() for part in outputs)

    return run


def onnxruntime_engine(path: Path, threads: int = 0) -> Engine:
    """ONNX Runtime engine of an .onnx file. `threads` 0: one thread per core that the CPU quota allows."""
    onnxruntime = package("onnxruntime")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads or _within_quota()
    # A spinning thread would block a core for other programs.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    with _readable(path):
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    names = _present({output.name for output in session.get_outputs()})
    return lambda images: tuple(session.run(names, {"images": images}))


def _present(names: set[str]) -> list[str]:
    """Outputs to read of a file with these outputs."""
    return [name for name in OUTPUT_NAMES if name in names or name != "shapes"]


@functools.cache
def openvino_core() -> Any:
    """The only `openvino.Core` of this process, kept until the process ends.

    Each core replaces the thread's signal stack, and restores the previous stack when the core is destroyed. If the
    lifetimes of several cores overlap, the last core restores an unmapped stack, and the next Ctrl-C ends Python with a
    segmentation fault.
    """
    return package("openvino").Core()


def openvino_engine(
    path: Path, precision: EnginePrecision = "f32", threads: int = 0, batch: int | None = None
) -> Engine:
    """OpenVINO engine of an .onnx or .xml file; `batch` fixes the number of images, which is faster.

    OpenVINO alone would use bfloat16 whenever the processor supports it; here `precision` decides.
    """
    core = openvino_core()
    with _readable(path):
        model = core.read_model(str(path))
    if batch is not None:
        model.reshape({0: [batch, *(side.get_length() for side in list(model.input(0).partial_shape)[1:])]})
    settings = {"INFERENCE_PRECISION_HINT": precision, "PERFORMANCE_HINT": "LATENCY"}
    if threads := threads or _within_quota():
        settings["INFERENCE_NUM_THREADS"] = str(threads)
    request = core.compile_model(model, "CPU", settings).create_infer_request()
    names = _present({output.get_any_name() for output in model.outputs})

    def run(images: Array) -> tuple[Array, ...]:
        outputs = request.infer({"images": images})
        return tuple(outputs[name].copy() for name in names)

    return run


def _within_quota() -> int:
    """Number of threads for an engine that ignores a container's CPU quota.

    Returns 0 if no quota limits the cores; the engine then chooses the number of threads.
    """
    return usable_cores() if usable_cores() < cores_in_affinity() else 0


def has_bf16() -> bool:
    """Whether OpenVINO computes in bfloat16 on this processor."""
    return "BF16" in openvino_core().get_property("CPU", "OPTIMIZATION_CAPABILITIES")


@contextlib.contextmanager
def _readable(path: Path) -> Any:
    """Check a network file, and turn any error of the block that reads it into a UserError."""
    if not path.is_file():
        raise UserError(path, "network", "no such file", _EXPECTED)
    if path.stat().st_size > MAX_WEIGHT_BYTES:
        raise UserError(path, "network", f"{path.stat().st_size} bytes", f"at most {MAX_WEIGHT_BYTES}")
    try:
        if path.suffix == ".onnx":
            _check_no_other_files(path)
        yield
    except UserError:
        raise
    except Exception as error:
        raise UserError(path, "network", error, _EXPECTED) from None


def _check_no_other_files(path: Path) -> None:
    """Raise UserError if an ONNX file refers to other files for its tensors.

    Such a file could make the engine read any file of the disk as weights.
    """
    model = package("onnx").load(str(path), load_external_data=False)
    names = [f"a tensor in the file {each.value!r}" for tensor in _tensors(model) for each in tensor.external_data]
    if names:
        raise UserError(path, "network", names[0], f"{_EXPECTED}, which contains all its tensors")


def _tensors(message: Any) -> Iterator[Any]:
    """All tensors of a protobuf message, at any depth."""
    if message.DESCRIPTOR.name == "TensorProto":
        yield message
        return
    for field, value in message.ListFields():
        # Search messages only: numbers contain no tensors, and a list of numbers may be long.
        if field.message_type is not None:
            for part in value if isinstance(value, Sequence) else [value]:
                yield from _tensors(part)
