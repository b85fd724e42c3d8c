"""`make paper`: settings as the paper has them, and the steps of the experiment."""

import importlib.util
import itertools
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import typer

from perilune_render.config.dataset import DatasetConfig
from perilune_shared.config.resolve import resolve
from perilune_shared.errors import UserError
from perilune_train.detect.config import DetectConfig
from perilune_train.motion.config import NavigateConfig
from perilune_train.training.runs import load_weights, save_weights

ROOT = Path(__file__).parent.parent
PROTOCOL = ROOT / "configs" / "paper_protocol.yaml"


@pytest.fixture(scope="module")
def script():
    """The module scripts/paper.py."""
    spec = importlib.util.spec_from_file_location("paper_script", ROOT / "scripts" / "paper.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["paper_script"] = module
    spec.loader.exec_module(module)
    return module


def experiment(script, **changes):
    given = {"preset": "paper", "part": script.Part.WHOLE, "ground": script.Ground.PANGU, "attitude": False}
    return script.Experiment(**(given | {"darknet": None, "benchmark": Path("b")} | changes))


def test_detection_is_as_in_the_paper():
    config = resolve(DetectConfig, "detect", "perilune_train", "paper", PROTOCOL)
    assert (config.width, config.in_channels, config.strides, config.attention) == (1, 3, (8, 16, 32), "cbam")
    assert config.labels.selection == "paper" and config.labels.radius_px == (2, 50)
    assert config.labels.min_contrast is None and config.labels.min_depth_ratio is None
    loss = config.loss
    assert (loss.aspect, loss.objectness, loss.lambda_iou, loss.lambda_obj) == ("circular", "hard", 0.05, 1)
    assert loss.reduction == "means" and config.anchor_sampling == "plain"
    assert config.assignment == "one" and config.init_layers == "from_second" and config.ema_decay == 0
    augment = config.augment.model_dump()
    assert augment.pop("scale") == (1, 1) and not any(augment.values())
    assert config.evaluation.scales == (1,)


def test_navigation_is_as_in_the_paper():
    stack = resolve(NavigateConfig, "navigate", "perilune_train", "paper", PROTOCOL).stack
    assert (stack.sequence_pairs, stack.batch_sequences, stack.hidden, stack.width) == (16, 8, 1000, 1)
    assert (stack.fine_epochs, stack.learning_rate, stack.cycles, stack.jitter) == (20, 1e-4, 5, 0)


@pytest.mark.parametrize("preset", ["paper", "tiny"])
def test_one_landing_area_seen_straight_down(preset):
    data = resolve(DatasetConfig, "dataset", "perilune_render", preset, PROTOCOL)
    assert data.shared_terrain and (data.detect.n_scenes, data.nav.n_scenes) == (1, 1)
    assert (data.detect.split_by, data.nav.split_by) == ("frame", "trajectory")
    for kind in (data.detect, data.nav):
        assert kind.flight.attitude_sigma_deg == 0 and (kind.val_share, kind.test_share) == (0.1, 0.1)
    if preset == "paper":
        assert (data.detect.trajectories_per_scene, data.nav.trajectories_per_scene) == (343, 49)
        assert (data.detect.n_frames, data.nav.n_frames) == (100, 100)


def commands(script, one):
    return {step.title: " ".join(step.command) for step in script.steps(one) if not callable(step.command)}


@pytest.mark.parametrize("part", ["whole", "gpu", "full"])
@pytest.mark.parametrize(("ground", "calibrate"), [("pangu", False), ("pangu", True), ("lunar", False)])
def test_each_step_comes_after_what_it_reads(script, part, calibrate, ground):
    made = script.steps(experiment(script, part=script.Part(part), ground=script.Ground(ground), calibrate=calibrate))
    titles = [step.title for step in made]
    assert len(set(titles)) == len(titles) and titles[-1] == "page"
    late = set()
    for step in made:
        late |= {need for need in step.needs if need not in titles[: titles.index(step.title)]}
    # Rendering of the curve may follow training on the headline ground, but nothing needs what is not there.
    assert late <= set(titles)
    assert not any(need == step.title for step in made for need in step.needs)


def test_networks_differ_by_attention_alone(script):
    found = commands(script, experiment(script))
    plain, attended = found["train yolov3"], found["train attention-yolov3"]
    assert plain.replace("attention=none", "attention=cbam").replace("yolov3", "attention-yolov3") == attended
    assert "detect/yolov3-half-0/checkpoints/best.ckpt" in found["train darknet53-lstm"], "two cores: half width"
    titles = list(found)
    assert titles.index("train yolov3-half-0") < titles.index("train darknet53-lstm") < titles.index("explain")
    assert len(set(titles)) == len(titles) and {f"train yolov3-half-{seed}" for seed in (0, 1, 2)} <= set(titles)
    found = commands(script, experiment(script, part=script.Part.GPU))
    plain, attended = found["train darknet53-lstm"], found["train attention-darknet53-lstm"]
    changed = plain.replace("attention=none", "attention=cbam").replace("yolov3", "attention-yolov3")
    assert changed.replace("darknet53-lstm", "attention-darknet53-lstm") == attended
    assert "detect.seed=2" in found["train yolov3-half-2"] and "detect.width=0.5" in found["train yolov3-half-2"]
    assert "detect/attention-yolov3/checkpoints/best.ckpt" in attended
    assert "target=pose" in attended and "target=motion" in found["train darknet53-lstm-motion"]


def test_the_curve_has_grounds_of_other_density(script):
    found = commands(script, experiment(script))
    assert "equilibrium_share={low: 0.25, high: 0.25}" in found["render 0.25"]
    assert "equilibrium_share: {low: 0.9, high: 1.7}" in found["render lunar"], "the usual ground"
    assert "equilibrium_share" not in found["render headline"], "as the protocol says"
    assert "data/paper/0.25/detect" in found["train curve-0.25"]


def test_the_headline_ground_is_chosen_where_the_baseline_has_the_papers_ap(script, tmp_path, monkeypatch):
    assert script.share_at({0.25: 0.95, 0.5: 0.90, 1.0: 0.70}, 0.95) == 0.25
    assert script.share_at({0.25: 0.95, 0.5: 0.90, 1.0: 0.70}, 0.80) == pytest.approx(0.5**0.5, abs=0.01)
    assert script.share_at({0.25: 0.95, 0.5: 0.90}, 0.85) == 1.0, "beyond the last point"
    assert script.share_at({0.25: 0.60, 0.5: 0.50}, 0.893) == 0.1, "not below the sparse ground"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(script, "PROTOCOL", PROTOCOL)
    one = experiment(script, part=script.Part.GPU, calibrate=True)
    for share, ap in (("0.25", 0.97), ("0.5", 0.893), ("1.0", 0.6)):
        run = one.runs / "detect" / f"curve-{share}"
        run.mkdir(parents=True)
        (run / "metrics.json").write_text(json.dumps({"val/ap50_paper": ap}))
    (choice,) = [step for step in script.steps(one) if callable(step.command)]
    assert not choice.done()
    choice.command()
    assert json.loads(one.chosen.read_text())["equilibrium_share"] == 0.5 and choice.done()
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(script.Experiment, "runs", property(lambda _: tmp_path / "runs" / "paper-gpu"))
    assert "equilibrium_share={low: 0.5, high: 0.5}" in commands(script, one)["render headline"]


def test_attitude_noise_and_given_weights(script):
    one = experiment(script, attitude=True, darknet=Path("yolov3.weights"))
    found = commands(script, one)
    assert "train transfer-yolov3" not in commands(script, experiment(script)), "too long for two cores"
    assert "detect.init_from=yolov3.weights" in found["train transfer-attention-yolov3"]
    without, noisy = found["render headline, navigation"], found["render attitude, navigation"]
    assert (
        noisy.replace(" --set dataset.nav.flight.attitude_sigma_deg=1.0", "").replace("/attitude", "/headline")
        == without
    )
    plain, noisy = found["train darknet53-lstm"], found["train darknet53-lstm-attitude"]
    assert noisy.replace("headline/nav", "").replace("attitude/nav", "").replace("-attitude", "") == plain.replace(
        "headline/nav", ""
    )
    assert "train darknet53-lstm-attitude" not in commands(script, experiment(script))
    assert experiment(script).runs == Path("runs/paper")
    assert experiment(script, part=script.Part.GPU).runs == Path("runs/paper-gpu")
    assert experiment(script, ground=script.Ground.LUNAR).runs == Path("runs/paper-lunar")


def test_what_trains_longer(script):
    found = commands(script, experiment(script, part=script.Part.GPU))
    for folder in (
        "long-yolov3",
        "sparse-yolov3",
        "sparse-attention-yolov3",
        "lunar-yolov3",
        "lunar-attention-identity",
    ):
        assert "detect.epochs=24" in found[f"train {folder}"], folder
    for folder in ("yolov3", "attention-identity", "yolov3-half-1", "curve-0.1", "curve-0.25", "curve-lunar"):
        assert "detect.epochs=12" in found[f"train {folder}"], folder
    assert "train long-yolov3" not in commands(script, experiment(script)), "too long for two cores"


def test_every_setting_of_every_step_is_valid(script):
    """Resolve the options of each command as it would itself."""
    models = {"detect": DetectConfig, "navigate": NavigateConfig, "dataset": DatasetConfig}
    for part, preset in itertools.product(script.Part, ("paper", "tiny")):
        for step in script.steps(experiment(script, part=part, preset=preset)):
            words = step.command
            sets = tuple(words[place + 1] for place, word in enumerate(words) if word == "--set")
            for section in {text.split(".")[0] for text in sets}:
                module = "perilune_render" if section == "dataset" else "perilune_train"
                assert resolve(models[section], section, module, preset, PROTOCOL, sets)


def test_too_little_disk_is_said_before_the_first_frame(script, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(script, "PROTOCOL", PROTOCOL)
    one = experiment(script)
    monkeypatch.setattr(script.shutil, "disk_usage", lambda _: SimpleNamespace(free=10**9))
    with pytest.raises(UserError, match=r"free disk: got 1\.0 GB, expected at least"):
        script.check_disk(one, script.steps(one))
    monkeypatch.setattr(script.shutil, "disk_usage", lambda _: SimpleNamespace(free=10**12))
    script.check_disk(one, script.steps(one))


def step(script, title, code, done, needs=(), **more):
    return script.Step(title, [sys.executable, "-c", code], done, needs, **more)


def test_steps_run_together_in_their_order_and_stop_in_time(script, tmp_path, monkeypatch):
    """Frames beside trainings, never three renderings; at the deadline the page is made of what is done."""
    monkeypatch.chdir(tmp_path)
    sizes = replace(script.PARTS[script.Part.GPU], renderings=2, trainings=3)
    monkeypatch.setitem(script.PARTS, script.Part.GPU, sizes)
    one = experiment(script, part=script.Part.GPU)
    mark = "import pathlib, time; pathlib.Path({!r}).touch(); time.sleep({}); pathlib.Path({!r}).touch()"

    def of(title, seconds, needs=(), **more):
        code = mark.format(f"{title}-begun", seconds, title)
        return step(script, title, code, Path(title).is_file, needs, **more)

    plan = [
        of("frames", 0.3, renders=True),
        of("more", 0.3, renders=True),
        of("third", 0.1, renders=True),
        of("network", 0.1, ("frames",)),
        of("late", 60, ("network",)),
        step(script, "broken", "raise SystemExit(3)", lambda: False),
        of("never", 0, ("broken",)),
        step(script, "page", "open('page', 'w')", lambda: False),
    ]
    monkeypatch.setattr(script, "steps", lambda _: plan)
    with pytest.raises(typer.Exit) as raised:
        script.run_all(one, {}, script.time.monotonic() + 4)
    assert raised.value.exit_code == 3, "the code of the broken step, after the page"
    assert all(Path(name).is_file() for name in ("frames", "third", "network", "late-begun", "page"))
    assert not Path("late").is_file() and not Path("never-begun").exists()
    begun, ended = (
        {name: Path(name + end).stat().st_mtime for name in ("frames", "more", "third", "network")}
        for end in ("-begun", "")
    )
    assert begun["network"] >= ended["frames"] and begun["third"] >= min(ended["frames"], ended["more"])
    assert begun["more"] < ended["frames"], "beside"


def test_a_failed_step_ends_the_experiment_with_its_code(script, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    plan = [
        step(script, "broken", "raise SystemExit(3)", lambda: False),
        step(script, "page", "open('page', 'w')", lambda: False),
    ]
    monkeypatch.setattr(script, "steps", lambda _: plan)
    with pytest.raises(typer.Exit) as raised:
        script.run_all(experiment(script), {}, float("inf"))
    assert raised.value.exit_code == 3 and not Path("page").exists()


STOPPED = """
import importlib.util, sys, pathlib
spec = importlib.util.spec_from_file_location("paper_script", sys.argv[1])
script = importlib.util.module_from_spec(spec)
sys.modules["paper_script"] = script
spec.loader.exec_module(script)
from perilune_shared.console.command_line import run_command_line
own = "import time; from perilune_shared.console.command_line import run_command_line as run; " \
    "import pathlib; pathlib.Path('begun').touch(); run(lambda **_: time.sleep(60))"
plan = [script.Step(title, [sys.executable, "-c", own], lambda: False) for title in ("a", "page")]
script.steps = lambda _: plan
one = script.Experiment("paper", script.Part[sys.argv[2]], script.Ground.PANGU, False, None, pathlib.Path("b"))
app = script.typer.Typer()
app.command()(lambda: script.run_all(one, {}, float("inf")))
sys.argv = sys.argv[:1]
run_command_line(app)
"""


@pytest.mark.parametrize("part", ["WHOLE", "GPU"])
def test_ctrl_c_ends_the_experiment_with_one_line(tmp_path, part):
    command = [sys.executable, "-c", STOPPED, str(ROOT / "scripts" / "paper.py"), part]
    process = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, process_group=0)
    while not (tmp_path / "begun").exists():
        assert process.poll() is None
        time.sleep(0.05)
    time.sleep(0.5)
    os.killpg(process.pid, signal.SIGINT)
    _, lines = process.communicate(timeout=60)
    assert process.returncode == 130 and lines.count("\n") == 1 and lines.startswith("stopped"), lines


def test_files_of_an_experiment_are_small_and_come_back(tmp_path):
    """Weights rounded to 8 bits, metrics and page survive packing and unpacking."""
    runs = tmp_path / "runs"
    network = torch.nn.Sequential(torch.nn.Conv2d(3, 8, 3), torch.nn.BatchNorm2d(8))
    save_weights(runs / "detect" / "attention-yolov3" / "checkpoints" / "best.ckpt", {"width": 1.0}, network)
    (runs / "detect" / "attention-yolov3" / "metrics.json").write_text('{"test/ap50_paper": 0.5}')
    (runs / "paper.md").write_text("# page")
    program = [sys.executable, str(ROOT / "scripts" / "paper_files.py")]
    for words in (["pack", runs, tmp_path / "files"], ["unpack", tmp_path / "files", tmp_path / "back"]):
        done = subprocess.run([*program, *map(str, words)], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    assert len(list((tmp_path / "files").iterdir())) == 3
    assert (tmp_path / "back" / "paper.md").read_text() == "# page"
    content = load_weights(tmp_path / "back" / "detect" / "attention-yolov3" / "checkpoints" / "best.ckpt")
    assert content["architecture"] == {"width": 1.0}
    for name, value in network.state_dict().items():
        step_size = value.abs().max() / 127 if value.ndim > 1 else 0
        assert (content["state_dict"][name] - value).abs().max() <= step_size / 2 + 1e-7
    done = subprocess.run([*program, "pack", str(tmp_path / "no"), "out"], capture_output=True, text=True)
    assert done.returncode == 2 and "no such folder" in done.stderr and done.stderr.count("\n") == 1
