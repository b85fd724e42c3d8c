"""Learning from a teacher: the term by hand, and a run."""

import json
import math

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from perilune_shared.config.resolve import resolve
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.batches import evaluation_loader, network_input
from perilune_train.detect.data.split import load_split
from perilune_train.detect.inference.detector import load_detector
from perilune_train.detect.train.detect_run import build_network, load_teacher, run_detect
from perilune_train.detect.train.distill import Teacher, distill_loss
from perilune_train.detect.train.task import DetectTask
from perilune_train.models.size import multiply_adds
from perilune_train.models.yolo import YOLOv3
from perilune_train.training import runs

ANCHORS, STRIDES = torch.full((3, 3, 2), 8.0), (4, 8, 16)


def outputs(seed=None):
    sizes = [(1, 3, 32 // stride, 32 // stride, 5) for stride in STRIDES]
    if seed is None:
        return [torch.zeros(size) for size in sizes]
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(size, generator=generator) for size in sizes]


def outspoken(anchors):
    """A network whose scores are anywhere between 0 and 1."""
    network = YOLOv3(anchors, 1, 0.25, "none", STRIDES).eval()
    for head in network.heads.values():
        torch.nn.init.normal_(head[1].weight, std=0.3)
        torch.nn.init.zeros_(head[1].bias)
    return network


def test_nothing_is_left_to_learn_from_oneself():
    raw = [part.requires_grad_() for part in outputs(0)]
    box, confidence = distill_loss(raw, [part.detach() for part in raw], ANCHORS, STRIDES)
    assert box.item() == pytest.approx(0, abs=1e-4)
    assert confidence.item() == pytest.approx(0, abs=1e-6)
    (box + confidence).backward()
    assert all(part.grad[..., 4].abs().max() < 1e-6 for part in raw)


def test_no_step_of_the_loss_needs_a_value():
    """A GPU would have to be waited for. Fake tensors have no values: an operation that needs one raises an error."""
    with FakeTensorMode():
        student, anchors = [part.requires_grad_() for part in outputs()], torch.full((3, 3, 2), 8.0)
        sum(distill_loss(student, outputs(), anchors, STRIDES)).backward()
        assert all(part.grad.shape == part.shape for part in student)


def test_objectness_by_hand():
    student, teacher = outputs(), outputs()
    teacher[1][0, 2, 1, 3, 4] = math.log(4)  # a score of 0.8 where the student says 0.5
    _, confidence = distill_loss(student, teacher, ANCHORS, STRIDES)
    divergence = 0.8 * math.log(0.8 / 0.5) + 0.2 * math.log(0.2 / 0.5)
    assert confidence.item() == pytest.approx(divergence / (3 * (64 + 16 + 4)), rel=1e-3)


def test_boxes_by_hand():
    student, teacher = outputs(), outputs()
    for part in teacher:
        part[..., 4] = -20.0
    teacher[0][0, 0, 2, 2, 4] = 2.0
    teacher[0][0, 0, 2, 2, 2] = math.log(2)  # twice as wide as the student's box: IoU 1 / 2
    box, _ = distill_loss(student, teacher, ANCHORS, STRIDES)
    v = 4 / math.pi**2 * (math.atan(2) - math.atan(1)) ** 2
    score = 1 / (1 + math.exp(-2))
    # Weighted by the score; below a sum of 1 the weights are not made up to 1.
    assert box.item() == pytest.approx(score * (0.5 + v / (0.5 + v) * v), rel=1e-4)


def test_a_teacher_who_sees_nothing_teaches_no_boxes():
    teacher = outputs()
    for part in teacher:
        part[..., 4] = -20.0
    box, confidence = distill_loss(outputs(1), teacher, ANCHORS, STRIDES)
    assert box.item() == 0
    assert confidence.item() > 0


@pytest.mark.slow
def test_steps_bring_the_student_to_the_teacher():
    torch.manual_seed(0)
    teacher = Teacher(outspoken(ANCHORS))
    student = YOLOv3(ANCHORS, 1, 0.125, "none", STRIDES)
    images = torch.randn(2, 1, 32, 32)
    optimizer = torch.optim.AdamW(student.parameters(), 3e-3)
    costs = []
    for _ in range(40):
        box, confidence = distill_loss(student(images), teacher(images), ANCHORS, STRIDES)
        optimizer.zero_grad()
        (box + confidence).backward()
        optimizer.step()
        costs.append((box.item(), confidence.item()))
    assert costs[-1][0] < 0.5 * costs[0][0]
    assert costs[-1][1] < 0.75 * costs[0][1]


QUICK = ("detect.epochs=1", "detect.precision=float32", "detect.device=cpu")


def settings(*more):
    return resolve(DetectConfig, "detect", "perilune_train", "tiny", None, (*QUICK, *more))


@pytest.fixture(scope="module")
def teacher_path(tmp_path_factory):
    path = tmp_path_factory.mktemp("teacher") / "best.ckpt"
    torch.manual_seed(1)
    reported = {"in_channels": 1, "width": 0.25, "attention": "none", "strides": [4, 8, 16]}
    runs.save_weights(path, reported, outspoken(torch.rand(3, 3, 2) + 6))
    return path


@pytest.mark.usefixtures("no_pictures")
def test_a_run_with_a_teacher(teacher_path, few, tmp_path):
    run = run_detect(settings(f"detect.teacher={teacher_path}"), few, tmp_path, "student")
    assert torch.equal(load_detector(run.best).anchors, load_detector(teacher_path).anchors)
    last = torch.load(run.last, weights_only=True)["state_dict"]
    assert not [key for key in last if "teacher" in key]
    assert json.loads(run.metrics.read_text())["multiply_adds"] == multiply_adds(
        load_detector(run.best), (1, 1, 96, 96)
    )


def test_the_teacher_adds_to_the_loss(teacher_path, dataset_detect):
    config = settings("detect.loss.lambda_teacher=3")
    split = load_split(open_dataset(dataset_detect), "val", config.labels)
    teacher = load_teacher(teacher_path, config)
    network = build_network(config, split.label_sizes_px, dataset_detect).eval()
    grey, targets = next(iter(evaluation_loader(split, config, network.anchors)))
    batch = network_input(grey, config.in_channels), targets
    costs = []
    for reported in (None, teacher):
        task = DetectTask(network, config, split, split, 0, reported)
        task.log_dict = lambda *_, **__: None
        costs.append(task.training_step(batch, 0).item())
    box, confidence = distill_loss(network(batch[0]), teacher(batch[0]), network.anchors, network.strides)
    assert costs[1] - costs[0] == pytest.approx(3 * (0.5 * box.item() + confidence.item()), rel=1e-4)


def test_a_teacher_of_other_strides_is_refused(teacher_path):
    with pytest.raises(UserError, match=r"best.ckpt: strides: got \[4, 8, 16\], expected \[8, 16, 32\]"):
        load_teacher(teacher_path, settings("detect.strides=[8, 16, 32]"))
    with pytest.raises(UserError, match=r"best.ckpt: in_channels: got 1, expected 3"):
        load_teacher(teacher_path, settings("detect.in_channels=3"))


def test_ellipse_outputs_take_no_part():
    """Student or teacher may predict ellipses; only boxes and scores are compared."""
    random = torch.Generator().manual_seed(6)
    student, teacher = ([torch.randn(1, 3, 4, 4, 10, generator=random)] for _ in range(2))
    anchors = torch.tensor([[[8.0, 8.0]] * 3])
    expected = distill_loss([student[0][..., :5]], [teacher[0][..., :5]], anchors, (8,))
    for own, other in ((student, teacher), (student, [teacher[0][..., :5]]), ([student[0][..., :5]], teacher)):
        torch.testing.assert_close(distill_loss(own, other, anchors, (8,)), expected)
