"""`make paper`: settings as the paper has them, and the steps of the experiment."""

import importlib.util
import sys
from pathlib import Path

import pytest

from perilune_render.config import DatasetConfig
from perilune_shared.config import resolve
from perilune_train.detect.config import DetectConfig
from perilune_train.navigate.config import NavigateConfig

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
    given = {"preset": "paper", "part": script.Part.WHOLE, "attitude": False, "darknet": None, "benchmark": Path("b")}
    return script.Experiment(**(given | changes))


def test_detection_is_as_in_the_paper():
    config = resolve(DetectConfig, "detect", "perilune_train", "paper", PROTOCOL)
    assert (config.width, config.in_channels, config.strides, config.attention) == (1, 3, (8, 16, 32), "cbam")
    assert config.labels.selection == "paper" and config.labels.radius_px == (2, 50)
    assert config.labels.min_contrast is None and config.labels.min_depth_ratio is None
    loss = config.loss
    assert (loss.aspect, loss.objectness, loss.lambda_iou, loss.lambda_obj) == ("circular", "hard", 0.05, 1)
    assert loss.reduction == "sums" and config.anchor_sampling == "plain"
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
    return {step.title: " ".join(step.command) for step in script.steps(one)}


def test_the_steps_of_a_quarter(script):
    one = experiment(script, part=script.Part.QUARTER)
    found = commands(script, one)
    assert "--where frame_index % 4 == 0" in found["take frame_index % 4 == 0"]
    assert "data/paper-quarter/plans/detect-quarter" in found["render detect"]
    assert "data/paper-quarter/plans/nav" in found["render nav"], "all frames of navigation"
    plain, attended = found["train yolov3"], found["train attention-yolov3"]
    assert plain.replace("attention=none", "attention=cbam").replace("yolov3", "attention-yolov3") == attended
    assert "detect.epochs=4" in plain and "detect.frozen_epochs=1" in plain and "detect/own/checkpoints" in plain
    navigator = found["train attention-darknet53-lstm"]
    assert "detect/attention-yolov3/checkpoints/best.ckpt" in navigator
    assert "batch_sequences=1" in navigator and "accumulate=8" in navigator
    titles = list(found)
    assert titles.index("train yolov3") < titles.index("train darknet53-lstm") < titles.index("explain")
    assert titles[-1] == "page"


def test_the_steps_of_a_twentieth(script):
    found = commands(script, experiment(script, part=script.Part.TWENTIETH))
    assert "--where frame_index % 20 == 0" in found["take frame_index % 20 == 0"]
    assert "data/paper-twentieth/plans/detect-twentieth" in found["render detect"]
    assert "--where trajectory_id < 'trajectory-0012'" in found["take trajectory_id < 'trajectory-0012'"]
    assert "data/paper-twentieth/plans/nav-twentieth" in found["render nav"]
    assert "detect.epochs=2" in found["train own network, to start from"]
    assert found["render the benchmark, detect"].endswith(" b-2-scenes 2"), (
        "two scenes of each part, in their own folder"
    )
    assert "--data b-2-scenes" in found["benchmark yolov3"]
    assert "6 of the 20 scenes" in found["page"] and "every twentieth" in found["page"]


def test_the_whole_is_not_cut(script):
    found = commands(script, experiment(script))
    assert not any(title.startswith("take ") for title in found)
    assert found["render the benchmark, detect"].endswith(" b 0") and "cut to fit" not in found["page"]
    assert "detect.epochs=5" in found["train own network, to start from"]


def test_the_second_experiment_and_given_weights(script):
    one = experiment(script, attitude=True, darknet=Path("yolov3.weights"))
    found = commands(script, one)
    assert "train own network, to start from" not in found
    assert "detect.init_from=yolov3.weights" in found["train attention-yolov3"]
    for kind in ("detect", "nav"):
        assert f"dataset.{kind}.flight.attitude_sigma_deg=1.0" in found[f"plan {kind}"]
    assert one.runs == Path("runs/paper-attitude")
    assert experiment(script).runs == Path("runs/paper")


def test_every_setting_of_every_step_is_valid(script):
    """Resolve the options of each training as its command would."""
    for part in script.Part:
        one = experiment(script, part=part)
        for title, section, model in (
            ("train attention-yolov3", "detect", DetectConfig),
            ("train darknet53-lstm", "navigate", NavigateConfig),
        ):
            (step,) = [step for step in script.steps(one) if step.title == title]
            words = step.command
            sets = tuple(words[place + 1] for place, word in enumerate(words) if word == "--set")
            assert sets and resolve(model, section, "perilune_train", "paper", PROTOCOL, sets)
