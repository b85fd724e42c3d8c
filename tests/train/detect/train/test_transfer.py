"""Starting from Darknet's files, frozen and unfrozen backbones, and writing a run as such a file."""

import filecmp
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.helpers import darknet_by_hand as by_hand
from tests.sampling import every
from typer.testing import CliRunner

from perilune_shared.config.resolve import resolve
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_train.cli.main import app
from perilune_train.detect.config import DetectConfig, LabelSettings
from perilune_train.detect.data.split import load_split
from perilune_train.detect.train.detect_run import build_network, run_detect
from perilune_train.detect.train.task import DetectTask
from perilune_train.detect.train.transfer import darknet_content, rescale_input, start_from
from perilune_train.models.darknet import AttentionDarknet53
from perilune_train.models.darknet_weights import read_darknet, write_darknet
from perilune_train.models.yolo import YOLOv3
from perilune_train.training import runs

N_BACKBONE = 40_620_640
FULL = DetectConfig(attention="cbam_identity")


@pytest.fixture(scope="module")
def coco(tmp_path_factory):
    """A file of the size of yolov3.weights, and its floats."""
    values = by_hand.random_values(by_hand.cfg(), 1.0, 3)
    path = tmp_path_factory.mktemp("darknet") / "yolov3.weights"
    path.write_bytes(by_hand.HEADER + values.tobytes())
    assert path.stat().st_size == 248_007_048
    yield path, values
    path.unlink()


def features_before_outputs(network: YOLOv3, images: torch.Tensor) -> list[torch.Tensor]:
    """What the last layer of each head gets, stride 32 first."""
    seen = []
    hooks = [
        network.heads[stride][1].register_forward_hook(lambda m, args, out: seen.append(args[0]))
        for stride in ("32", "16", "8")
    ]
    with torch.no_grad():
        network(images)
    for hook in hooks:
        hook.remove()
    return seen


def test_normalised_frames_give_the_stem_what_grey_values_gave():
    torch.manual_seed(0)
    plain, rescaled = (AttentionDarknet53(3, 0.25, stages=1).eval() for _ in range(2))
    plain.stem.norm.running_mean.normal_()
    rescaled.load_state_dict(plain.state_dict())
    rescale_input(rescaled, "normalised")
    frames = torch.randn(1, 3, 16, 16)
    inner = (slice(None), slice(None), slice(1, -1), slice(1, -1))
    with torch.no_grad():
        torch.testing.assert_close(rescaled.stem(frames)[inner], plain.stem(0.25 * frames + 0.45)[inner])
    rescale_input(rescaled, "grey")
    for key, value in plain.state_dict().items():
        torch.testing.assert_close(rescaled.state_dict()[key], value, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_the_published_size_is_written_again_byte_for_byte(coco, tmp_path):
    path, values = coco
    content = read_darknet(path, (62_001_757,))
    np.testing.assert_array_equal(content.values, values)
    write_darknet(tmp_path / "again.weights", content)
    assert filecmp.cmp(path, tmp_path / "again.weights", shallow=False)
    tmp_path.joinpath("again.weights").unlink()


def test_yolov3_fills_backbone_neck_and_heads_but_no_output(coco):
    path, values = coco
    torch.manual_seed(0)
    network = YOLOv3(None, 3, 1.0, FULL.attention).eval()
    outputs = {key: value.clone() for key, value in network.state_dict().items() if ".1.weight" in key}
    assert sum(key.startswith("heads.") for key in outputs) == 3
    start_from(network, path, FULL)
    frames = torch.randn(1, 1, 64, 64, generator=torch.Generator().manual_seed(0)).expand(-1, 3, -1, -1)
    # Exact in the grey scale of the file; in ours the border of the image differs by the padding.
    rescale_input(network.backbone, "grey")
    grey = 0.25 * frames + 0.45
    layers = by_hand.cfg()
    with torch.no_grad():
        out = by_hand.run(layers, by_hand.HEADER + values.tobytes(), grey, 1.0)
    expected = [out[index - 2] for index, layer in enumerate(layers) if layer[0] == "yolo"]
    for one, other in zip(features_before_outputs(network, grey), expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-3 * float(other.abs().max()))
    after = network.state_dict()
    assert all(torch.equal(after[key], outputs[key]) for key in outputs if key.startswith("heads."))
    gates = network.backbone.attentions["B_54"]
    assert not gates.excite.weight.any() and not gates.spatial.weight.any()


@pytest.mark.parametrize("kind", every(3, ["darknet53.conv.74", "weights.bin", "yolov3.weights"]))
def test_a_backbone_alone_is_filled_from_conv_74_or_for_finer_strides(coco, tmp_path, kind):
    path, values = coco
    if kind != path.name:
        path = tmp_path / kind
        path.write_bytes(by_hand.HEADER + values[:N_BACKBONE].tobytes())
    torch.manual_seed(0)
    network = YOLOv3(None, 3, 1.0, "none", (4, 8, 16))
    before = network.branches["8"][0].conv.weight.clone()
    start_from(network, path, DetectConfig(attention="none", strides=(4, 8, 16)))
    last = network.backbone.units["B_54"].expand.conv.weight.detach().numpy()
    np.testing.assert_array_equal(last.ravel(), values[N_BACKBONE - last.size : N_BACKBONE])
    assert torch.equal(network.branches["8"][0].conv.weight, before)
    if kind != "yolov3.weights":
        path.unlink()


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("detect.width=0.5", "yolov3.weights: detect.width: got 0.5, expected 1, as in Darknet's files"),
        ("detect.in_channels=1", "yolov3.weights: detect.in_channels: got 1, expected 3, as in Darknet's files"),
        ("detect.width=1", "yolov3.weights: size: got 24 bytes: a header and 1 floats, expected 40620640 or "),
    ],
)
def test_a_network_or_file_of_another_shape_is_refused_before_anything_is_written(
    dataset_detect, tmp_path, setting, message
):
    path = tmp_path / "yolov3.weights"
    path.write_bytes(by_hand.HEADER + bytes(4))
    config = resolve(DetectConfig, "detect", "perilune_train", "paper", None, (f"detect.init_from={path}", setting))
    with pytest.raises(UserError) as caught:
        run_detect(config, dataset_detect, tmp_path / "runs", "a")
    assert message in str(caught.value) and "\n" not in str(caught.value)
    assert not (tmp_path / "runs").exists()


def call(*arguments):
    return CliRunner().invoke(app, ["detect", "weights", *map(str, arguments)])


def saved(path: Path, attention: str = "none", strides=(8, 16, 32), width: float = 1.0) -> YOLOv3:
    torch.manual_seed(1)
    network = YOLOv3(None, 3, width, attention, strides)
    architecture = {"in_channels": 3, "width": width, "attention": attention, "strides": list(strides)}
    runs.save_weights(path, architecture, network)
    return network


@pytest.mark.parametrize("suffix", every(2, [".conv.74", ".weights"]))
def test_a_run_is_written_as_a_darknet_file_and_comes_back(tmp_path, suffix):
    """Also the output layers, which have 15 filters in a file of ours."""
    network = saved(tmp_path / "best.ckpt")
    out = tmp_path / f"ours{suffix}"
    result = call(tmp_path / "best.ckpt", "--out", out)
    assert result.exit_code == 0, result.output
    assert out.stat().st_size == 20 + 4 * (N_BACKBONE if suffix == ".conv.74" else 61_570_957)
    torch.manual_seed(2)
    again = YOLOv3(None, 3, 1.0, "none")
    start_from(again, out, DetectConfig(attention="none"))
    filled = again if suffix == ".weights" else again.backbone
    expected = (network if suffix == ".weights" else network.backbone).state_dict()
    for key, value in filled.state_dict().items():
        if "num_batches" in key:
            continue
        if key.endswith("stem.norm.running_mean"):  # rescaled there and back
            torch.testing.assert_close(value, expected[key], rtol=0, atol=1e-6)
        else:
            assert torch.equal(value, expected[key]), key
    for path in tmp_path.iterdir():
        path.unlink()


@pytest.mark.parametrize(
    ("name", "shape", "message"),
    [
        (
            "a.bin",
            {},
            "a.bin: --out: got the name a.bin, expected a name that ends in .safetensors, .conv.74 or .weights",
        ),
        ("a.conv.74", {"width": 0.125}, "best.ckpt: width: got 0.125, expected 1.0"),
        ("a.weights", {"width": 0.125}, "best.ckpt: width: got 0.125, expected 1.0"),
        ("absent.weights", None, "best.ckpt: checkpoint: got no such file"),
    ],
)
def test_what_has_no_darknet_file_is_refused(tmp_path, name, shape, message):
    if shape:
        saved(tmp_path / "best.ckpt", **shape)
    result = call(tmp_path / "best.ckpt", "--out", tmp_path / name)
    assert isinstance(result.exception, UserError) and message in str(result.exception)
    assert not (tmp_path / name).exists()


def test_a_whole_file_holds_no_gates_and_no_finer_strides(tmp_path):
    with torch.device("meta"):
        network = YOLOv3()
    shape = {"in_channels": 3, "width": 1.0, "attention": "cbam", "strides": [8, 16, 32]}
    with pytest.raises(UserError, match=r"best.ckpt: attention: got cbam, expected none"):
        darknet_content(network, shape, Path("best.ckpt"), whole=True)
    with pytest.raises(UserError, match=r"strides: got \[4, 8, 16\], expected \[8, 16, 32\]"):
        darknet_content(network, {**shape, "strides": [4, 8, 16]}, Path("best.ckpt"), whole=True)


# ---- the frozen backbone

QUICK = ("detect.epochs=2", "detect.frozen_epochs=1", "detect.width=0.125", "detect.precision=float32")


def parts(network: YOLOv3) -> dict[str, dict[str, torch.Tensor]]:
    """Copies of what is frozen, of the gates, and of the rest."""
    found: dict[str, dict[str, torch.Tensor]] = {"frozen": {}, "gates": {}, "rest": {}}
    for key, value in network.state_dict().items():
        if "num_batches" not in key and key != "anchors":
            kind = "rest" if not key.startswith("backbone.") else "gates" if ".attentions." in key else "frozen"
            found[kind][key] = value.clone()
    return found


def same(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> set[bool]:
    return {torch.equal(first[key], second[key]) for key in first}


@pytest.mark.usefixtures("no_pictures")
def test_a_run_leaves_the_backbone_alone_in_its_frozen_epochs_only(few, tmp_path, monkeypatch):
    """Weights and batch statistics, through optimiser, weight decay and moving average; gates and head learn."""
    start = YOLOv3(None, 1, 0.125, "cbam_identity", (4, 8, 16))
    for key, value in start.backbone.state_dict().items():
        if key.endswith("running_mean"):
            value.normal_()
    architecture = {"in_channels": 1, "width": 0.125, "attention": "cbam_identity", "strides": [4, 8, 16]}
    runs.save_weights(tmp_path / "best.ckpt", architecture, start)
    states = []

    def recorded(hook):
        def record(self):
            hook(self)
            states.append((parts(self.network), parts(self.evaluated)))

        return record

    for name in ("on_train_start", "on_train_epoch_end"):
        monkeypatch.setattr(DetectTask, name, recorded(getattr(DetectTask, name)))
    settings = (*QUICK, "detect.ellipses=false", f"detect.init_from={tmp_path / 'best.ckpt'}")
    config = resolve(DetectConfig, "detect", "perilune_train", "tiny", None, settings)
    run_detect(config, few, tmp_path / "runs", "a")
    (before, _), (frozen, frozen_average), (after, after_average) = states
    assert same(before["frozen"], parts(start)["frozen"]) == {True}
    assert same(before["frozen"], frozen["frozen"]) == {True}
    assert same(before["frozen"], frozen_average["frozen"]) == {True}
    assert same(before["gates"], frozen["gates"]) == {False}
    assert same(before["rest"], frozen["rest"]) == {False}
    assert same(frozen["frozen"], after["frozen"]) == {False}
    assert same(frozen["frozen"], after_average["frozen"]) == {False}


@pytest.mark.usefixtures("no_pictures")
def test_the_heads_of_the_ellipses_are_trained_alone(few, tmp_path):
    """All other weights and batch statistics stay, through optimiser, weight decay and moving average."""
    architecture = {"in_channels": 1, "width": 0.125, "attention": "cbam_identity", "strides": [4, 8, 16]}
    start = YOLOv3(torch.rand(3, 3, 2) + 4, 1, 0.125, "cbam_identity", (4, 8, 16))
    runs.save_weights(tmp_path / "best.ckpt", architecture, start)
    settings = (*QUICK, "detect.frozen_epochs=0", f"detect.init_from={tmp_path / 'best.ckpt'}")
    settings = (*settings, "detect.attention=cbam_identity", "detect.trained=ellipses")
    config = resolve(DetectConfig, "detect", "perilune_train", "tiny", None, settings)
    run = run_detect(config, few, tmp_path / "runs", "a")
    trained = runs.load_weights(run.best)["state_dict"]
    assert {key for key, value in start.state_dict().items() if not torch.equal(trained[key], value)} == set()
    heads = [key for key in trained if key.startswith("ellipse_tower.") and key.endswith("conv.weight")]
    assert heads and all(trained[key].std() > 0 for key in heads)
    # The weights are those after the last step.
    last = runs.read_saved(run.last, "last state", {"state_dict"}, "a state")["state_dict"]
    assert all(torch.equal(last[f"evaluated.{key}"], value) for key, value in trained.items())


@pytest.mark.parametrize("missing", ["detect.ellipses=false", "detect.init_from=null", "detect.frozen_epochs=1"])
def test_heads_of_ellipses_alone_need_a_trained_network(missing):
    given = ("detect.trained=ellipses", "detect.init_from=a.ckpt", "detect.ellipses=true", "detect.epochs=2")
    with pytest.raises(UserError, match="trained=ellipses with ellipses=true, init_from and frozen_epochs=0"):
        resolve(DetectConfig, "detect", "perilune_train", "tiny", None, (*given, missing))


@pytest.mark.parametrize("attention", ["none", "cbam_identity"])
def test_the_frozen_forward_keeps_no_graph_that_nobody_needs(dataset_detect, tmp_path, attention):
    split = load_split(open_dataset(dataset_detect), "train", LabelSettings())
    config = DetectConfig(width=0.125, in_channels=1, epochs=2, strides=(4, 8, 16), attention=attention)
    task = DetectTask(build_network(config, split.label_sizes_px, tmp_path), config, split, split, frozen_epochs=1)
    task.on_train_epoch_start()
    images = torch.randn(1, 1, 64, 64)
    # Without gates nothing in the backbone learns, so that autograd records nothing of it.
    assert {f.requires_grad for f in task.network.backbone(images)} == {attention != "none"}
    sum(out.square().mean() for out in task.network(images)).backward()
    backbone = task.network.backbone
    assert all(p.grad is None for part in (backbone.stem, backbone.downs, backbone.units) for p in part.parameters())
    assert all(p.grad is not None for p in task.network.heads.parameters())


def test_without_a_file_nothing_is_frozen(few, tmp_path, monkeypatch):
    def stop(self, batch, batch_idx):
        raise KeyError(str([p.requires_grad for p in self.network.parameters()].count(False)))

    monkeypatch.setattr(DetectTask, "training_step", stop)
    config = resolve(DetectConfig, "detect", "perilune_train", "tiny", None, QUICK)
    with pytest.raises(KeyError, match="'0'"):
        run_detect(config, few, tmp_path, "a")


def test_new_plain_gates_before_a_frozen_backbone_are_refused(tmp_path):
    """They would shrink what the frozen layers get; gates of the same run, or gates that start at 1, would not."""
    config = DetectConfig(width=0.125, in_channels=1, epochs=2, frozen_epochs=1, strides=(4, 8, 16))
    paths = {}
    for attention in ("none", "cbam"):
        architecture = {"in_channels": 1, "width": 0.125, "attention": attention, "strides": [4, 8, 16]}
        paths[attention] = tmp_path / f"{attention}.ckpt"
        runs.save_weights(paths[attention], architecture, YOLOv3(None, 1, 0.125, attention, (4, 8, 16)))

    def begin(source: str, **settings: object) -> None:
        changed = config.model_copy(update=settings)
        start_from(YOLOv3(None, 1, 0.125, changed.attention, (4, 8, 16)), paths[source], changed)

    with pytest.raises(UserError, match=r"none.ckpt: detect.attention: got cbam with frozen_epochs .*cbam_identity"):
        begin("none", attention="cbam")
    begin("cbam", attention="cbam")
    begin("none", attention="cbam_identity")
    begin("none", attention="cbam", frozen_epochs=0)
    begin("none", attention="cbam", plain_gates_before_frozen_layers=True)


def test_the_first_layer_can_be_left_out(tmp_path):
    """The paper takes its backbone from the second layer on."""
    config = DetectConfig(width=0.125, in_channels=1, strides=(4, 8, 16), attention="none", init_layers="from_second")
    architecture = {"in_channels": 1, "width": 0.125, "attention": "none", "strides": [4, 8, 16]}
    given, network = (YOLOv3(None, 1, 0.125, "none", (4, 8, 16)) for _ in range(2))
    runs.save_weights(tmp_path / "a.ckpt", architecture, given)
    stem = network.backbone.stem.conv.weight.clone()
    start_from(network, tmp_path / "a.ckpt", config)
    assert torch.equal(network.backbone.stem.conv.weight, stem)
    rest = [key for key in given.state_dict() if not key.startswith("backbone.stem.")]
    assert all(torch.equal(given.state_dict()[key], network.state_dict()[key]) for key in rest)


@pytest.mark.parametrize("given, wanted", [(False, True), (True, False), (True, True)])
def test_ellipse_outputs_come_from_a_file_that_has_them(tmp_path, given, wanted):
    """All other weights and the anchors come from the file in every case."""
    shape = {"in_channels": 1, "width": 0.125, "attention": "none", "strides": (4, 8, 16)}
    source = YOLOv3(torch.rand(3, 3, 2) + 4, **shape, ellipses=given)
    architecture = shape | {"strides": [4, 8, 16]} | ({"ellipses": True} if given else {})
    runs.save_weights(tmp_path / "a.ckpt", architecture, source)
    network = YOLOv3(None, **shape, ellipses=wanted)
    before = {key: value.clone() for key, value in network.state_dict().items()}
    start_from(network, tmp_path / "a.ckpt", DetectConfig(**shape, ellipses=wanted))
    after, saved = network.state_dict(), source.state_dict()
    assert any(key.startswith("ellipse_tower.") for key in after) == wanted
    for key, value in after.items():
        kept = key.startswith("ellipse_tower.") and not given
        assert torch.equal(value, before[key] if kept else saved[key]), key
    images = torch.randn(1, 1, 64, 64, generator=torch.Generator().manual_seed(0))
    source.eval(), network.eval()
    torch.testing.assert_close(network.detect(images), source.detect(images))


def test_ellipse_outputs_have_no_place_in_a_darknet_file(tmp_path):
    with torch.device("meta"):
        network = YOLOv3(None, 3, 1.0, "none", ellipses=True)
    shape = {"in_channels": 3, "width": 1.0, "attention": "none", "strides": [8, 16, 32], "ellipses": True}
    with pytest.raises(UserError, match="ellipses: got True, expected False; the checkpoint has another architecture"):
        darknet_content(network, shape, Path("best.ckpt"), whole=True)
