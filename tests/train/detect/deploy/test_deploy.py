"""The folded network, the exported files, and the command that writes them."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn
from typer.testing import CliRunner

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_train.cli.main import app
from perilune_train.data.frames import load_frames, normalised
from perilune_train.detect.calibration import Calibration
from perilune_train.detect.deploy import export, int8
from perilune_train.detect.deploy.engines import onnxruntime_engine, openvino_engine, torch_engine
from perilune_train.detect.deploy.files import FlightDetector, write_onnx, write_openvino
from perilune_train.detect.deploy.readme import readme
from perilune_train.detect.finished_run import config_of_run
from perilune_train.models.yolo import YOLOv3
from perilune_train.records.metrics_file import write_metrics
from perilune_train.training import runs

onnx = pytest.importorskip("onnx", reason="the extra `export` is not installed")
SIZE = 96


def lively(attention="cbam_identity", strides=(4, 8, 16), in_channels=1, ellipses=False):
    """A network whose every weight and statistic matters, in evaluation mode."""
    torch.manual_seed(3)
    network = YOLOv3(3 + 20 * torch.rand(3, 3, 2), in_channels, 0.125, attention, strides, ellipses).eval()
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.momentum = 0.8
            if module.affine:
                nn.init.uniform_(module.weight, 0.5, 1.5)
                nn.init.uniform_(module.bias, -0.5, 0.5)
        elif isinstance(module, nn.Linear) or (isinstance(module, nn.Conv2d) and not module.weight.any()):
            nn.init.normal_(module.weight, std=0.1)
    for head in network.heads.values():
        nn.init.normal_(head[1].weight, std=0.5)
        nn.init.constant_(head[1].bias, -1.0)
    if network.ellipse_tower is not None:
        for layer in network.ellipse_tower.output.values():
            nn.init.normal_(layer.weight, std=0.3)
    with torch.no_grad():
        network.train()(torch.randn(4, in_channels, SIZE, SIZE))
    return network.eval()


@pytest.fixture(scope="module")
def images(dataset_detect):
    frames = load_frames(open_dataset(dataset_detect), "val").images
    return normalised(frames[:3])[:, None]


@pytest.mark.parametrize(
    ("attention", "strides"),
    [("none", (8, 16, 32)), ("cbam", (4, 8, 16)), ("cbam_identity", (4, 8, 16)), ("cbam_last", (4, 8, 16))],
)
def test_folding_changes_nothing(attention, strides, images):
    network = lively(attention, strides)
    before = network.state_dict()
    folded = FlightDetector(network, SIZE)
    assert not [m for m in folded.modules() if isinstance(m, nn.BatchNorm2d)]
    assert network.state_dict().keys() == before.keys()
    boxes, scores = network.detect(torch.as_tensor(images))
    found_boxes, found_scores = torch_engine(folded)(images)
    assert scores.max() - scores.min() > 0.2
    np.testing.assert_allclose(found_boxes, boxes, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(found_scores, scores, atol=1e-4)


def test_files_give_torchs_ellipses(images, tmp_path):
    network = lively(ellipses=True)
    boxes, scores, shapes = (part.numpy() for part in network.detect_ellipses(torch.as_tensor(images)))
    assert np.ptp(shapes[..., 0]) > 1 and np.ptp(np.log(shapes[..., 1:]), axis=(0, 1)).min() > 1
    path = tmp_path / "detector.onnx"
    write_onnx(FlightDetector(network, SIZE), path, {}, 1, SIZE)
    write_openvino(path, tmp_path / "detector.xml")
    for engine in (
        torch_engine(FlightDetector(network, SIZE)),
        onnxruntime_engine(path, 1),
        openvino_engine(tmp_path / "detector.xml", threads=1),
    ):
        found = engine(images)
        assert len(found) == 3
        for part, expected in zip(found, (boxes, scores, shapes), strict=True):
            np.testing.assert_allclose(part, expected, rtol=1e-3, atol=1e-3)
        px, score = export.difference(network, engine, images, 0.1)
        assert px < 1e-3 and score < 1e-3
        # A difference of the ellipses alone is seen.
        assert export.difference(network, lambda given, e=engine: (*e(given)[:2], e(given)[2] + 0.01), images, 0.1) == (
            pytest.approx((0.01, 0.01), abs=2e-3)
        )
        plain = lively()
        assert export.difference(plain, engine, images, 0.1) == (np.inf, np.inf)


def test_a_size_that_no_stride_divides():
    with pytest.raises(ValueError, match="100"):
        FlightDetector(lively(), 100)


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    """A run as training leaves it, with lively weights."""
    run = runs.RunFolder(tmp_path_factory.mktemp("runs") / "detect" / "a")
    message = {"in_channels": 1, "width": 0.125, "attention": "cbam_identity", "strides": [4, 8, 16]}
    runs.save_weights(run.best, message, lively())
    text = "detect:\n  width: 0.125\n  in_channels: 1\n  attention: cbam_identity\n  strides: [4, 8, 16]\n"
    run.config.write_text(text, encoding="utf-8")
    write_metrics(run.root, {"test/threshold": 0.4})
    return run.root


def test_settings_come_from_the_run_alone(run_folder):
    """config.yaml of this run lacks most settings: they have their defaults, not those of a preset."""
    config = export.load_trained(run_folder).config
    assert config == config_of_run(run_folder)
    assert (config.warmup_steps, config.workers, config.strides) == (100, 0, (4, 8, 16))


@pytest.fixture(scope="module")
def exported(run_folder, dataset_detect, tmp_path_factory):
    out = tmp_path_factory.mktemp("export") / "flight"
    export.export_run(run_folder, out, export.ExportedFiles(size_px=SIZE), dataset_detect)
    return out


def test_files_give_torchs_boxes_for_any_number_of_images(exported, images):
    boxes, scores = (part.numpy() for part in lively().detect(torch.as_tensor(images)))
    for engine in (
        onnxruntime_engine(exported / "detector.onnx", 1),
        openvino_engine(exported / "detector.xml", threads=1),
        openvino_engine(exported / "detector.onnx", threads=1),
    ):
        for n in (3, 1):
            found_boxes, found_scores = engine(images[:n])
            np.testing.assert_allclose(found_scores, scores[:n], atol=1e-4)
            counts = scores[:n] > 0.01
            np.testing.assert_allclose(found_boxes[counts], boxes[:n][counts], atol=1e-3, rtol=1e-5)
    one = openvino_engine(exported / "detector.xml", threads=1, batch=1)
    np.testing.assert_allclose(one(images[1:2])[1], scores[1:2], atol=1e-4)


@pytest.mark.slow
def test_no_engine_leaves_an_identity_or_sends_telemetry(exported, tmp_path):
    """The builds of ONNX Runtime send events to their maker, and keep an identity below the home folder for it."""
    code = (
        "import sys; from pathlib import Path; from perilune_train.detect.deploy import engines\n"
        "engines.package('onnxruntime.quantization'); engines.onnxruntime_engine(Path(sys.argv[1]), 1)\n"
    )
    command = [sys.executable, "-c", code, str(exported / "detector.onnx")]
    names = ("CI", "ORT_DISABLE_TELEMETRY", "ORT_TELEMETRY_DISABLED", "XDG_CACHE_HOME", "PYTEST_CURRENT_TEST")
    alone = {name: value for name, value in os.environ.items() if name not in names}
    subprocess.run(command, check=True, env={**alone, "HOME": str(tmp_path)})
    assert not [path for path in tmp_path.rglob("*") if "onnxruntime" in path.name]


INTERRUPTED = """
import os, signal, sys, time
from pathlib import Path
from perilune_train.detect.deploy.engines import has_bf16, openvino_engine
for _ in range(3):
    engine = openvino_engine(Path(sys.argv[1]), threads=1)
has_bf16()
del engine
try:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(10)
except KeyboardInterrupt:
    print("interrupted")
"""


@pytest.mark.slow
def test_ctrl_c_after_several_engines(exported):
    """OpenVINO replaces the signal stack of the thread; several cores left one that was unmapped, and Python died."""
    command = [sys.executable, "-c", INTERRUPTED, str(exported / "detector.xml")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "interrupted\n"), done.stderr


def test_no_batch_norm_remains_and_the_facts_are_inside(exported):
    model = onnx.load(str(exported / "detector.onnx"))
    kinds = {node.op_type for node in model.graph.node}
    assert "Conv" in kinds
    assert "BatchNormalization" not in kinds
    message = json.loads((exported / "detector.json").read_text())
    inside = {entry.key: json.loads(entry.value) for entry in model.metadata_props}
    for key in ("anchors_px", "strides", "score_threshold", "input", "outputs", "nms_iou"):
        assert inside[key] == message[key], key
    assert message["score_threshold"] == 0.4
    assert message["strides"] == [4, 8, 16]
    np.testing.assert_allclose(message["anchors_px"], lively().anchors, rtol=1e-6)
    assert message["compared_on"] == "validation frames"
    assert set(message["files"]) == {"detector.onnx", "detector.xml", "detector.bin"}
    for found in message["differences_from_torch"].values():
        assert found["largest_px"] <= 1e-3


def test_the_readmes_program_finds_what_we_find(exported, dataset_detect, images):
    program = (exported / "README.md").read_text().split("```python\n")[1].split("```")[0]
    grey = load_frames(open_dataset(dataset_detect), "val").images[0]
    np.save(exported.parent / "grey.npy", grey)
    program += (
        "\nboxes, scores = detect(np.load('../grey.npy'))\nprint(json.dumps([boxes.tolist(), scores.tolist()]))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=exported, capture_output=True, text=True, check=True)
    boxes, scores = map(np.array, json.loads(done.stdout))
    from perilune_train.detect.config import EvaluationSettings
    from perilune_train.detect.inference.suppression import detections_of

    (own,) = detections_of(*lively().detect(torch.as_tensor(images[:1])), EvaluationSettings(min_score=0.4))
    assert len(own.scores) > 3
    np.testing.assert_allclose(boxes, own.boxes, atol=1e-3)
    np.testing.assert_allclose(scores, own.scores, atol=1e-4)


def test_the_readme_has_the_probability_of_a_score(run_folder, tmp_path):
    """The exported network has the scores of training, so its threshold is the one before calibration."""
    run = tmp_path / "run"
    shutil.copytree(run_folder, run)
    assert "a score is no probability" in readme(export.export_metadata(export.load_trained(run), SIZE) | {"files": {}})
    calibration = Calibration(0.7, 2.9, -2.0)
    entries = {f"calibration/{name}": value for name, value in asdict(calibration).items()}
    entries |= {"calibration/raw_threshold": 0.4, "calibration/threshold": calibration.probability(0.4)}
    write_metrics(run, {"test/threshold": 0.4, **entries})
    metadata = export.export_metadata(export.load_trained(run), SIZE)
    assert metadata["score_threshold"] == 0.4
    assert {key: metadata["score_calibration"][key] for key in asdict(calibration)} == asdict(calibration)
    formula = metadata["score_calibration"]["probability"]
    assert f"`{formula}`" in readme(metadata | {"files": {}})
    done = subprocess.run(
        [sys.executable, "-c", f"from math import exp, log\ns = 0.6\nprint({formula})"], capture_output=True, text=True
    )
    assert float(done.stdout) == pytest.approx(calibration.probability(0.6), rel=1e-5)


def test_a_file_that_differs_is_not_left(run_folder, tmp_path, monkeypatch):
    original = export.FlightDetector

    def wrong(network, size_px):
        made = original(network, size_px)
        made.network.heads["8"][1].bias.data[2] += 0.01
        return made

    monkeypatch.setattr(export, "FlightDetector", wrong)
    with pytest.raises(UserError, match=r"detector.onnx: onnxruntime: got boxes 0.*px.*expected at most 0.001 px"):
        export.export_run(run_folder, tmp_path / "flight", export.ExportedFiles(("onnx",), SIZE))
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def quantise_once():
    """`int8.quantise` that computes its file at the first call and writes the same one at later calls."""
    made = []

    def quantise(source, out, images):
        if not made:
            original(source, out, images)
            made.append(out.read_bytes())
        out.write_bytes(made[0])

    original = int8.quantise
    return quantise


@pytest.mark.slow
@pytest.mark.parametrize("most_loss", [1.0, -1.0])
def test_int8_is_evaluated_and_kept_only_if_better(
    run_folder, dataset_detect, tmp_path, monkeypatch, quantise_once, most_loss
):
    """Both verdicts: no loss is small enough, and every one is, while int8 is called the faster."""
    monkeypatch.setattr(int8, "quantise", quantise_once)
    monkeypatch.setattr(int8, "MAX_AP_LOSS", most_loss)
    timed = int8.interleaved
    monkeypatch.setattr(int8, "interleaved", lambda *given: timed(*given) | {"int8": [0.0]})
    verdict = export.export_run(run_folder, tmp_path / "a", export.ExportedFiles(("onnx",), SIZE, True), dataset_detect)
    assert verdict.kept == (most_loss > 0)
    assert 0 <= verdict.ap50_paper_int8 <= 1 and verdict.float_s > 0
    assert (tmp_path / "a" / "detector-int8.onnx").exists() == verdict.kept
    message = json.loads((tmp_path / "a" / "detector.json").read_text())
    assert message["int8"]["kept"] == verdict.kept
    assert ("detector-int8.onnx" in message["files"]) == verdict.kept
    assert not (tmp_path / "a" / "detector.xml").exists()


@pytest.mark.parametrize("missing", ["onnx", "onnxruntime", "openvino", "onnxruntime.quantization"])
def test_without_the_extra_one_line_says_what_to_install(run_folder, dataset_detect, tmp_path, monkeypatch, missing):
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(UserError, match=rf"{missing}: got not installed, expected pip install"):
        export.export_run(run_folder, tmp_path / "a", export.ExportedFiles(size_px=SIZE, int8=True), dataset_detect)
    assert list(tmp_path.iterdir()) == []


def test_quantised_files_hold_integers_but_for_gates_and_heads(exported, images, tmp_path):
    int8.quantise(exported / "detector.onnx", tmp_path / "q.onnx", images)
    graph = onnx.load(str(tmp_path / "q.onnx")).graph
    made = {output: node.op_type for node in graph.node for output in node.output}
    quantised = {n.name for n in graph.node if n.op_type == "Conv" and made.get(n.input[0]) == "DequantizeLinear"}
    every = {n.name for n in graph.node if n.op_type == "Conv"}
    assert "/network/backbone/stem/conv/Conv" in every
    assert len(quantised) > 50 and "/network/heads.4/heads.4.0/conv/Conv" in quantised
    assert not [name for name in quantised if "squeeze" in name or "spatial" in name or "heads.4.1" in name]
    boxes, scores = onnxruntime_engine(tmp_path / "q.onnx", 1)(images)
    _, exact = lively().detect(torch.as_tensor(images))
    assert 1e-4 < np.abs(scores - exact.numpy()).mean() < 0.1
    assert np.isfinite(boxes).all()


@pytest.mark.parametrize(
    ("loss", "seconds", "kept"), [(0.004, 0.5, True), (0.006, 0.5, False), (0.004, 1.1, False), (-0.1, 0.9, True)]
)
def test_when_int8_is_worth_it(loss, seconds, kept):
    verdict = int8.Int8Verdict(0.8, 0.8 - loss, 1.0, seconds, "f32")
    assert verdict.kept == kept
    assert verdict.summary().startswith("int8 kept" if kept else "int8 not kept")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--formats", "onnx,tflite"], "--formats: got onnx,tflite"),
        (["--int8"], "--int8: got no --dataset"),
        (["--size-px", "100"], "--size-px: got 100, expected a multiple of 32"),
        (["--run", "nowhere"], "nowhere: run: got no such folder, expected a detect run; train one: perilune-train"),
    ],
)
def test_wrong_options_leave_nothing(run_folder, tmp_path, options, words):
    result = CliRunner().invoke(app, ["detect", "deploy", "--run", run_folder, "--out", tmp_path / "x", *options])
    assert isinstance(result.exception, UserError)
    assert words in str(result.exception)
    assert list(tmp_path.iterdir()) == []


def test_frames_of_another_size(run_folder, dataset_detect, tmp_path):
    with pytest.raises(UserError, match="frames: got 96 x 96, expected 256 x 256"):
        export.export_run(run_folder, tmp_path / "x", export.ExportedFiles(("onnx",)), dataset_detect)


def test_engines_refuse_what_is_no_network(tmp_path):
    path = Path(tmp_path, "detector.onnx")
    path.write_bytes(b"nothing of the kind")
    for engine in (onnxruntime_engine, openvino_engine):
        with pytest.raises(UserError, match=r"detector.onnx: network: got "):
            engine(path)
        with pytest.raises(UserError, match="no such file"):
            engine(tmp_path / "absent.onnx")
