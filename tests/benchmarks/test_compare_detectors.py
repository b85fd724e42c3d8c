"""The witness RT-DETRv2 and its comparison with YOLOv3."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.split import DetectSplit, load_split
from perilune_train.detect.evaluate.metrics import curve
from perilune_train.detect.evaluate.split_evaluation import match_detections
from perilune_train.detect.inference.scales import detect_at_scales
from perilune_train.detect.train.detect_run import run_detect
from tests.helpers.drawn_dataset import build_dataset

pytest.importorskip("transformers", reason="transformers is not installed: make setup-dev installs it")

from benchmarks.train import compare_detectors, witness

SMALL = {
    "width": 0.125,
    "attention": "cbam_last",
    "in_channels": 1,
    "strides": (4, 8, 16),
    "epochs": 1,
    "batch_size": 2,
    "precision": "float32",
    "device": "cpu",
}


@pytest.fixture(scope="module", autouse=True)
def _no_pictures() -> Iterator[None]:
    """Evaluations draw no pictures, which take most of their time."""
    with pytest.MonkeyPatch.context() as patched:
        for name in ("draw_bins", "draw_curves", "draw_frames"):
            patched.setattr(f"perilune_train.detect.evaluate.report.{name}", lambda *_, **__: None)
        yield


@pytest.fixture(scope="module")
def few(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a dataset with six frames of 96 px to train on, two of val and two of test."""
    return build_dataset(tmp_path_factory.mktemp("few") / "few", "detect", n_frames=2)


@pytest.fixture(scope="module")
def train(few: Path) -> DetectSplit:
    return load_split(open_dataset(few), "train", DetectConfig().labels)


def settings(split: DetectSplit, **changes) -> witness.WitnessConfig:
    """Settings of a small witness."""
    config = witness.witness_config(DetectConfig(**{**SMALL, **changes}), split)
    return config.model_copy(update={"channels": 32, "decoder_layers": 2})


def test_labels_are_fractions_of_the_frame_and_ignored_labels_are_apart():
    outlines = np.array([[10, 20, 30, 60, 0.1], [-10, 0, 10, 20, 0.0]])
    target = witness.target_of(outlines, np.array([True, False]), 100, 200)
    torch.testing.assert_close(target["boxes"], torch.tensor([[0.2, 0.2, 0.2, 0.2]]))
    torch.testing.assert_close(target["ignored"], torch.tensor([[0.0, 0.0, 0.1, 0.1]]))
    assert target["class_labels"].tolist() == [0]


def test_only_queries_on_ignored_labels_are_not_penalised(train):
    criterion = witness.WitnessLoss(witness.build_witness(settings(train)).settings)
    boxes = torch.tensor([[[0.2, 0.2, 0.1, 0.1], [0.7, 0.7, 0.1, 0.1], [0.5, 0.2, 0.1, 0.1]]])
    logits = torch.zeros(1, 3, 1, requires_grad=True)
    target = witness.target_of(np.array([[15, 15, 25, 25, 0], [66, 65, 76, 75, 0]]), np.array([True, False]), 100, 100)
    match = [(torch.tensor([0]), torch.tensor([0]))]
    loss = criterion.loss_labels_vfl({"pred_boxes": boxes, "logits": logits}, [target], match, 1)["loss_vfl"]
    on_label, on_ignored, on_nothing = torch.autograd.grad(loss, logits)[0][0, :, 0].tolist()
    # The target score of a matched query is the IoU of its box, here 1.
    assert on_label == pytest.approx(-0.5)
    assert on_ignored == 0
    assert on_nothing == pytest.approx(criterion.alpha * 0.5**criterion.gamma * 0.5)


def test_queries_suffice_for_the_fullest_frame(train):
    most = max(int(labels.selected.sum()) for labels in train.labels)
    assert witness.witness_config(DetectConfig(), train).queries >= max(100, 1.25 * most)


def test_two_frames_are_learned(train):
    two = train.first(2)
    config = settings(two, augment={"flips_and_turns": False})
    task = witness.WitnessTask(witness.build_witness(config), config, two, two)
    detector = compare_detectors.detector_of(task.network, config, "cpu")

    def average_precision() -> float:
        detector.network.eval()
        found = detect_at_scales(detector, two.frames.images)
        detector.network.train()
        return curve(match_detections(two, found, config)).ap_paper()

    before, losses = average_precision(), []
    optimizer = torch.optim.AdamW(task.network.parameters(), lr=3e-3)
    batch = task.transfer_batch_to_device(next(iter(task.train_dataloader())), torch.device("cpu"), 0)
    for number in range(40):
        loss = task.training_step(batch, number)
        optimizer.zero_grad()
        loss.backward()
        task.configure_gradient_clipping(optimizer)
        optimizer.step()
        losses.append(loss.item())
    after = average_precision()
    assert losses[-1] < 0.7 * losses[0]
    assert before < 0.01 and after > 0.1


def test_batches_without_labels_have_a_loss(train):
    config = settings(train)
    task = witness.WitnessTask(witness.build_witness(config), config, train, train)
    nothing = witness.target_of(np.empty((0, 5)), np.empty(0, bool), 96, 96)
    loss = task.training_step((torch.randn(2, 1, 96, 96), [nothing, nothing]), 0)
    loss.backward()
    assert torch.isfinite(loss) and loss > 0


def test_noise_depends_on_seed_and_batch_only(train):
    config = settings(train)
    task = witness.WitnessTask(witness.build_witness(config), config, train, train)
    batch = task.transfer_batch_to_device(next(iter(task.train_dataloader())), torch.device("cpu"), 0)
    task.network.eval()
    task.network.network.training = True
    first, again, other = (task.training_step(batch, number).item() for number in (0, 0, 1))
    assert first == again != other


@pytest.fixture(scope="module")
def compared(few: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Folders of two finished detect runs, with and without attention."""
    runs = tmp_path_factory.mktemp("runs")
    folders = [
        run_detect(DetectConfig(**{**SMALL, "attention": form}), few, runs, form).root for form in ("cbam_last", "none")
    ]
    return folders[0], folders[1]


def test_the_comparison_is_complete_and_is_resumed(few, compared, tmp_path, monkeypatch):
    monkeypatch.setattr(compare_detectors, "_TURNS", 1)
    compare_detectors.main(few, *compared, out=tmp_path)
    figures = json.loads((tmp_path / "compare_detectors.json").read_text())
    names = [compare_detectors.PLAIN, compare_detectors.ATTENTION, compare_detectors.FRAMES, compare_detectors.TIME]
    assert [name for name in figures if name != "run"] == names
    for name in names:
        own = figures[name]
        assert own["parameters"] > 0 and own["multiply_adds"] > 0 and own["training_s_per_frame"] > 0
        assert 0 <= own["ap50_paper"] <= 1 and own["strict/ap50_paper"] <= own["ap50_paper"]
    assert figures[names[0]]["frames_seen"] == figures[names[2]]["frames_seen"] == 6
    text = (tmp_path / "compare_detectors.md").read_text()
    assert "| AP, strict |" in text and "| AP, 2 to 3 px radius |" in text
    weights = tmp_path / "frames" / "checkpoints" / "best.ckpt"
    before = weights.stat().st_mtime_ns
    compare_detectors.main(few, *compared, out=tmp_path)
    assert weights.stat().st_mtime_ns == before


def test_a_witness_that_is_killed_within_an_epoch_is_resumed_with_the_same_weights(few, train, tmp_path, monkeypatch):
    config = settings(train, epochs=2, checkpoint_minutes=0)
    data = compare_detectors.Data.of(few, config)
    whole, killed = (compare_detectors.runs.RunFolder(tmp_path / name) for name in ("whole", "killed"))
    compare_detectors.train_witness(whole, config, data)
    original = witness.WitnessTask.training_step

    def dies(self, batch, batch_idx):
        if self.current_epoch == 1 and batch_idx == 1:
            raise KeyError("killed")
        return original(self, batch, batch_idx)

    with monkeypatch.context() as patched:
        patched.setattr(witness.WitnessTask, "training_step", dies)
        with pytest.raises(KeyError):
            compare_detectors.train_witness(killed, config, data)
    assert not killed.metrics.is_file()
    compare_detectors.train_witness(killed, config, data)
    first, again = (torch.load(run.last, weights_only=True) for run in (whole, killed))
    assert first["global_step"] == again["global_step"] == 6
    assert all(torch.equal(value, again["state_dict"][name]) for name, value in first["state_dict"].items())


def test_runs_that_differ_in_more_than_attention_are_refused(few, compared, tmp_path):
    run, baseline = compared
    other = tmp_path / "wide"
    shutil.copytree(baseline, other)
    text = (other / "config.yaml").read_text()
    assert "width: 0.125" in text
    (other / "config.yaml").write_text(text.replace("width: 0.125", "width: 0.25"))
    with pytest.raises(UserError, match=r"detect\.width"):
        compare_detectors.compared_config(run, other, few)
    elsewhere = build_dataset(tmp_path / "other", "detect", n_frames=3)
    with pytest.raises(UserError, match="dataset"):
        compare_detectors.compared_config(run, baseline, elsewhere)


def test_equal_processor_time():
    slow, quick = (compare_detectors.Cost(1, 1, seconds, 1.0) for seconds in (2.5, 1.0))
    assert compare_detectors.equal_time_epochs(5, quick, slow) == 2
    assert compare_detectors.equal_time_epochs(5, slow, quick) == 12
    assert compare_detectors.equal_time_epochs(1, quick, slow) == 1
