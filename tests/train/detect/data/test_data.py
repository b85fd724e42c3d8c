"""Labels that are selected, augmentation, order, batches."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import quaternion_from_matrix
from perilune_train.data import frames
from perilune_train.data.shares import Share
from perilune_train.detect.config import AugmentSettings, DetectConfig, LabelSettings
from perilune_train.detect.data.augment import augment, grey_levels, rescale, turn
from perilune_train.detect.data.batches import (
    TrainingFrames,
    evaluation_loader,
    network_input,
    training_loader,
)
from perilune_train.detect.data.ignored import Craters, unlabelled_craters
from perilune_train.detect.data.split import load_split
from perilune_train.detect.ellipses import ellipses_of

PLAIN = AugmentSettings(flips_and_turns=False, gain=0.0, gamma=0.0, blur_px=0.0, noise=0.0)
ANCHORS = torch.tensor([[[8.0, 8.0], [12.0, 12.0], [16.0, 16.0]], [[20.0, 20.0]] * 3, [[32.0, 32.0]] * 3])
PINNED_ORDER = [19, 20, 11, 0, 10, 14, 17, 22, 1, 5, 6, 2, 9, 8, 7, 15, 16, 3, 4, 18, 23, 12, 21, 13]


@pytest.fixture(scope="module")
def split(dataset_detect):
    return load_split(open_dataset(dataset_detect), "train", LabelSettings())


def test_worn_craters_are_ignored_and_no_others(dataset_detect, split):
    dataset = open_dataset(dataset_detect)
    labels = dataset.table("labels").to_pandas()
    # In this dataset every fourth crater is worn to a depth of 0.01 diameters.
    for name, part in zip(split.frames.table["frame_id"], split.labels, strict=True):
        rows = labels[labels["frame_id"] == name]
        assert part.selected[part.labelled].tolist() == (rows["crater_id"] % 4 != 3).tolist()
        np.testing.assert_array_equal(part.boxes[part.labelled, 0], rows["bbox_x0_px"])
    assert any((~part.selected).any() for part in split.labels)
    everything = load_split(dataset, "train", LabelSettings(min_depth_ratio=0.0, min_contrast=0.0))
    assert all(part.selected[part.labelled].all() for part in everything.labels)
    paper = load_split(dataset, "train", LabelSettings(selection="paper"))
    assert [part.selected.tolist() for part in paper.labels] == [part.selected.tolist() for part in everything.labels]
    large = load_split(dataset, "train", LabelSettings(selection="paper", radius_px=(10.0, 50.0)))
    assert large.radius_px == (10.0, 50.0)
    for part in large.labels:
        np.testing.assert_array_equal(part.selected[part.labelled], part.radius_px[part.labelled] >= 10)


def test_craters_that_show_too_little_are_ignored(dataset_detect):
    """In this dataset worn craters have a contrast of 1, the others of 20."""
    plain = {"selection": "paper", "min_contrast": None}
    dataset = open_dataset(dataset_detect)
    shares = []
    for least in (None, 1.0, 1.1, 20.0, 20.1):
        split = load_split(dataset, "train", LabelSettings(**{**plain, "min_contrast": least}))
        shares.append(np.mean(np.concatenate([part.selected[part.labelled] for part in split.labels])))
    assert shares[0] == shares[1] == 1 > shares[2] == shares[3] > 0.5 and shares[4] == 0


def test_the_default_range_of_radii_is_that_of_the_whole_dataset(dataset_detect):
    dataset = open_dataset(dataset_detect)
    radius_px = dataset.table("labels").to_pandas()["radius_px"]
    splits = [load_split(dataset, name, LabelSettings(selection="all")) for name in ("train", "test")]
    assert {split.radius_px for split in splits} == {(radius_px.min(), radius_px.max())}
    assert all(part.selected[part.labelled].all() for part in splits[0].labels)


def flat_craters(*places):
    """Craters at (x, y) in the plane z = 0 with a diameter, metres."""
    x, y, diameter = np.array(places, float).T
    zero = np.zeros(len(x))
    centre, normal = np.column_stack([x, y, zero]), np.column_stack([zero, zero, zero + 1])
    return Craters(np.arange(len(x)), centre, normal, diameter, diameter / 5)


def test_craters_just_outside_the_labelled_range_are_ignored():
    camera = Camera(100, 100, 100.0, 100.0, 50.0, 50.0)
    # Straight down from 100 m: a pixel is a metre, O_L's x is the image's x, its y runs up.
    frame = {"position_m": [0.0, 0.0, 100.0], "rotation_wxyz": quaternion_from_matrix(np.diag([1.0, -1.0, -1.0]))}
    craters = flat_craters((0, 10, 2.0), (20, 0, 3.6), (-20, 0, 130.0), (0, 0, 160.0), (52, 0, 20.0), (80, 0, 20.0))
    shapes = unlabelled_craters(craters, camera, frame, (2.0, 50.0))
    # Radius 1 px: too small; 1.8 px; 65 px; 80 px: too large; off the image but reaching in; altogether off.
    np.testing.assert_allclose(shapes[:, 4], [1.8, 65.0, 10.0], rtol=1e-6)
    np.testing.assert_allclose(shapes[:, 5:7], [[70, 50], [30, 50], [102, 50]], atol=1e-6)
    np.testing.assert_allclose(shapes[:, 0], [68.2, -35, 92], atol=1e-6)
    # A crater that has a label is not ignored.
    others = unlabelled_craters(craters, camera, frame, (2.0, 50.0), labelled=np.array([1, 4]))
    np.testing.assert_array_equal(others, shapes[1:2])


def test_what_is_ignored_reaches_as_far_as_frames_are_resized():
    camera = Camera(100, 100, 100.0, 100.0, 50.0, 50.0)
    frame = {"position_m": [0.0, 0.0, 100.0], "rotation_wxyz": quaternion_from_matrix(np.diag([1.0, -1.0, -1.0]))}
    craters = flat_craters(*((0, 0, 2 * radius) for radius in (0.6, 1.1, 1.8, 65.0, 110.0, 150.0)))

    def ignored(*scale):
        return unlabelled_craters(craters, camera, frame, (2.0, 50.0), scale)[:, 4].round(6).tolist()

    # Of the radii times the factors, those from 2 sqrt(1/2) to 50 sqrt(2) pixels.
    assert ignored(1.0, 1.0) == [1.8, 65.0]
    assert ignored(1.0, 2.0) == [1.1, 1.8, 65.0]
    assert ignored(0.5, 1.0) == [1.8, 65.0, 110.0]
    assert ignored(1.5, 2.0) == ignored(1.0, 2.0)


def test_a_distorted_camera_ignores_craters_where_it_sees_them():
    """Barrel distortion draws a crater off the image into it; one beyond the fold of the distortion is nowhere."""
    plain = Camera(100, 100, 100.0, 100.0, 50.0, 50.0)
    barrel = replace(plain, distortion=(-0.3, 0.0, 0.0, 0.0, 0.0))
    frame = {"position_m": [0.0, 0.0, 100.0], "rotation_wxyz": quaternion_from_matrix(np.diag([1.0, -1.0, -1.0]))}
    craters = flat_craters((53.0, 0.0, 3.6), (300.0, 0.0, 3.6))
    assert len(unlabelled_craters(craters, plain, frame, (2.0, 50.0))) == 0
    shapes = unlabelled_craters(craters, barrel, frame, (2.0, 50.0))
    np.testing.assert_allclose(shapes[:, 5], [50 + 53 * (1 - 0.3 * 0.53**2)], atol=0.02)


def test_a_fisheye_ignores_craters_where_it_sees_them():
    """60 degrees from the axis, a crater appears at r = f theta, and its radius is smaller than near the axis."""
    fisheye = Camera(160, 160, 45.0, 45.0, 80.0, 80.0, model="equidistant")
    frame = {"position_m": [0.0, 0.0, 100.0], "rotation_wxyz": quaternion_from_matrix(np.diag([1.0, -1.0, -1.0]))}
    x = 100 * np.tan(np.radians(60))
    shapes = unlabelled_craters(flat_craters((x, 0.0, 22.0), (-x, 0.0, 2.0)), fisheye, frame, (2.0, 50.0))
    np.testing.assert_allclose(shapes[0, 5:7], [80 + 45 * np.radians(60), 80.0], atol=0.1)
    # Along the image's radius, 11 m appear under 11 cos(60)^2 / 100 rad; across it, under 11 cos(60) theta / sin / 100.
    across = 45 * 0.11 * 0.5 * np.radians(60) / np.sin(np.radians(60))
    np.testing.assert_allclose(shapes[0, 7:9], [across, 45 * 0.11 * 0.25], rtol=0.03)
    assert len(shapes) == 1, "the other crater is too small"


def test_frames_that_do_not_divide_by_32_are_refused(tmp_path, make_dataset):
    root = make_dataset(tmp_path / "odd", "detect", side_px=100, n_frames=1, craters=20)
    with pytest.raises(UserError, match=r"width_px: got 100, expected a multiple of 32.* develop the frames at 96 px"):
        load_split(open_dataset(root), "train", LabelSettings())


SIDE = st.integers(1, 3)


@given(kind=st.integers(0, 7), x=st.integers(0, 4), y=st.integers(0, 6), size=st.tuples(SIDE, SIDE))
def test_turns_move_boxes_with_the_pixels(kind, x, y, size):
    image = np.zeros((9, 9), np.uint8)
    image[y : y + size[1], x : x + size[0]] = 255
    turned, boxes = turn(image, np.array([[x, y, x + size[0], y + size[1], 0.0]], float), kind)
    rows, columns = np.nonzero(turned)
    assert boxes[:, :4].tolist() == [[columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]]


def test_the_eight_turns_differ():
    image = np.arange(9, dtype=np.uint8).reshape(3, 3)
    assert len({turn(image, np.zeros((0, 5)), kind)[0].tobytes() for kind in range(8)}) == 8


def test_outlines_are_those_of_the_labelled_ellipses(split):
    """A box and a correlation give back the ellipse of each label, also of craters that are ignored."""
    outlines, ellipses = (np.concatenate([getattr(p, name) for p in split.labels]) for name in ("outlines", "ellipses"))
    assert len(outlines) > 100 and (outlines[:, 4] != 0).all()
    found = ellipses_of(outlines[:, :4], outlines[:, 4])
    np.testing.assert_allclose(found[:, :4], ellipses[:, :4], atol=1e-3)
    long = ellipses[:, 2] - ellipses[:, 3] > 0.05
    turn = (found[:, 4] - ellipses[:, 4] + np.pi / 2) % np.pi - np.pi / 2
    np.testing.assert_allclose(turn[long], 0, atol=0.02)
    assert long.any()


def changed(split, settings, seed=0, index=0):
    image, labels = split.frames.images[index], split.labels[index]
    pixels, boxes, selected = augment(
        image, labels.outlines, labels.selected, split.radius_px, settings, np.random.default_rng(seed)
    )
    return image, labels, pixels, boxes[:, :4], selected


def test_augmentation_off_changes_nothing(split):
    image, labels, pixels, boxes, selected = changed(split, PLAIN)
    np.testing.assert_allclose(pixels, image, atol=1e-3)
    np.testing.assert_array_equal(boxes, labels.boxes)
    np.testing.assert_array_equal(selected, labels.selected)


@pytest.mark.parametrize(
    "setting", [{"gain": 0.5}, {"gamma": 0.5}, {"blur_px": 3.0}, {"noise": 5.0}, {"levels": 1.0}, {"jpeg": 1.0}]
)
def test_each_augmentation_changes_the_pixels_alone(split, setting):
    image, labels, pixels, boxes, selected = changed(split, PLAIN.model_copy(update=setting), 1)
    assert np.abs(pixels - image).mean() > 0.3
    np.testing.assert_array_equal(boxes, labels.boxes)
    np.testing.assert_array_equal(selected, labels.selected)


@pytest.mark.parametrize("factor", [0.6, 1.0, 1.37, 2.5])
@pytest.mark.parametrize("place", [(0.1, 0.3), (0.35, 0.6)])
def test_rescaling_moves_boxes_with_the_pixels(factor, place):
    image = np.zeros((96, 128), np.float32)
    image[40:52, 30:46] = 200
    scaled, boxes = rescale(image, np.array([[30.0, 40.0, 46.0, 52.0, 0.0]]), factor, place)
    # The bright rectangle, its mass and its middle, in pixels counted from the image's edge.
    x0, y0, x1, y1 = boxes[0, :4].clip(0, [128, 96, 128, 96])
    bright = np.clip(scaled - image.mean() * (factor < 1), 0, None)
    rows, columns = np.indices(scaled.shape) + 0.5
    inside = (columns > x0 - 2) & (columns < x1 + 2) & (rows > y0 - 2) & (rows < y1 + 2)
    weight = bright * inside
    assert weight.sum() / 200 == pytest.approx((x1 - x0) * (y1 - y0), rel=0.06)
    assert (weight * columns).sum() / weight.sum() == pytest.approx((x0 + x1) / 2, abs=0.1)
    assert (weight * rows).sum() / weight.sum() == pytest.approx((y0 + y1) / 2, abs=0.1)


def test_what_rescaling_takes_out_of_range_or_off_the_image_is_wanted_no_more(split):
    for seed in range(8):
        settings = PLAIN.model_copy(update={"scale": (0.5, 2.0)})
        _, labels, pixels, boxes, selected = changed(split, settings, seed)
        assert pixels.shape == split.frames.images[0].shape
        centre, radius = (boxes[:, :2] + boxes[:, 2:]) / 2, np.sqrt((boxes[:, 2:] - boxes[:, :2]).prod(1)) / 2
        assert 0 < len(boxes) <= len(labels.boxes)
        assert ((centre[selected] >= 0) & (centre[selected] < 96)).all()
        assert (radius[selected] >= split.radius_px[0]).all() and selected.any()


def test_stretching_clips_the_given_share_at_most(split):
    image = split.frames.images[0]
    shares = []
    for seed in range(20):
        levels = grey_levels(image, PLAIN.model_copy(update={"stretch": 0.2}), np.random.default_rng(seed))
        assert (np.diff(levels) >= 0).all() and levels.min() == 0 and levels.max() == 255
        # A level that holds the quantile belongs to neither side.
        shares.append([(image < np.flatnonzero(levels > 0)[0] - 1).mean(), (levels[image] == 255).mean()])
    shares = np.array(shares)
    assert 0.1 < shares[:, 0].max() <= 0.2
    assert 0.1 < shares[:, 1].max() < 0.25
    assert np.ptp(shares, axis=0).min() > 0.05


def test_reduced_grey_levels_and_compression_affect_their_fraction_of_the_frames(split):
    image, counts, errors = split.frames.images[0], [], []
    for seed in range(40):
        few = changed(split, PLAIN.model_copy(update={"levels": 0.5}), seed)[2]
        counts.append(len(np.unique(few)))
        compressed = changed(split, PLAIN.model_copy(update={"jpeg": 0.5}), seed)[2]
        errors.append(np.abs(compressed - image).mean())
    reduced = np.array(counts) <= 64
    assert 10 <= reduced.sum() <= 30 and np.ptp(np.array(counts)[reduced]) > 10
    assert 10 <= (np.array(errors) == 0).sum() <= 30 and max(errors) < 12


def test_one_scale_for_all_frames(split):
    before, labels, pixels, boxes, _ = changed(split, PLAIN.model_copy(update={"scale": (2.0, 2.0)}))
    assert not np.array_equal(pixels, before)
    sizes = {tuple((box[2:] - box[:2]).round(6)) for box in boxes}
    assert sizes <= {tuple((2 * (box[2:] - box[:2])).round(6)) for box in labels.boxes}


def test_scales_are_least_and_largest():
    with pytest.raises(ValueError, match="smaller factor first"):
        AugmentSettings(scale=(2.0, 1.0))


def test_an_epoch_follows_from_seed_and_number_alone(split):
    first, again = (TrainingFrames(split, DetectConfig(seed=5)) for _ in range(2))
    order = [number for _, number in first.keys(2)]
    assert sorted(order) == list(range(len(split)))
    assert first.keys(2) == again.keys(2) and order != [number for _, number in first.keys(3)]
    # The sample does not depend on what was drawn before it.
    again[2, 0]
    np.testing.assert_array_equal(first[2, 3][0], again[2, 3][0])
    assert not np.array_equal(first[2, 3][0], first[3, 3][0])


def test_the_order_of_an_epoch_is_pinned(split):
    """A run resumed with a later version sees the same frames."""
    assert [number for _, number in TrainingFrames(split, DetectConfig(seed=7)).keys(1)] == PINNED_ORDER


def test_each_process_loads_its_own_frames_and_labels(dataset_detect, split, monkeypatch):
    dataset, decoded = open_dataset(dataset_detect), []
    decode = frames.decode
    monkeypatch.setattr(frames, "decode", lambda *more: decoded.append(0) or decode(*more))
    shares = [load_split(dataset, "train", LabelSettings(), share=Share(process, 3)) for process in range(3)]
    assert len(decoded) == len(split) == sum(map(len, shares))
    for process, own in enumerate(shares):
        np.testing.assert_array_equal(own.frames.images, split.frames.images[process::3])
        np.testing.assert_array_equal(own.label_sizes_px, split.label_sizes_px)
        for part, expected in zip(own.labels, split.labels[process::3], strict=True):
            for name, values in vars(expected).items():
                np.testing.assert_array_equal(getattr(part, name), values)
    with pytest.raises(UserError, match="train frames: got 24, expected at least 25, one for each process"):
        load_split(dataset, "train", LabelSettings(), share=Share(0, 25))


def test_processes_augment_a_frame_as_one_process_does(split, dataset_detect):
    config = DetectConfig(seed=3)
    whole = TrainingFrames(split, config)
    own = TrainingFrames(load_split(open_dataset(dataset_detect), "train", config.labels, share=Share(1, 2)), config)
    epoch, number = own.keys(4)[0]
    np.testing.assert_array_equal(own[epoch, number][0], whole[epoch, 2 * number + 1][0])


def test_batches(split):
    config = DetectConfig(batch_size=5, in_channels=3)
    batches = list(evaluation_loader(split, config, ANCHORS))
    assert [len(images) for images, _ in batches] == [5, 5, 5, 5, 4]
    grey, targets = batches[1]
    assert grey.shape == (5, 96, 96)
    torch.testing.assert_close(grey.mean((1, 2)), torch.zeros(5), atol=1e-4, rtol=0)
    torch.testing.assert_close(grey.std((1, 2)), torch.ones(5), atol=1e-2, rtol=0)
    images = network_input(grey, config.in_channels)
    assert images.shape == (5, 3, 96, 96)
    assert images.is_contiguous(memory_format=torch.channels_last)
    assert torch.equal(images[:, 0], grey) and torch.equal(images[:, 2], grey)
    assert [part.ignored.shape for part in targets] == [(5, 3, side, side) for side in (12, 6, 3)]
    for frame, labels in enumerate(split.labels[5:10]):
        # Each selected label has a predictor at some scale, and no other box has one.
        assigned = torch.cat([part.boxes[part.predictors[0] == frame] for part in targets])
        assert {tuple(box) for box in assigned.tolist()} == {
            tuple(box) for box in labels.boxes[labels.selected].astype(np.float32).tolist()
        }


@pytest.mark.slow
def test_workers_under_spawn_give_the_same_batches(split):
    """`spawn` pickles the frames and the function that makes batches of them."""
    config = DetectConfig(batch_size=2, in_channels=1, workers=1, seed=3)
    batches = training_loader(split.first(4), config, ANCHORS)
    batches.multiprocessing_context = "spawn"
    beside = list(batches)
    alone = list(training_loader(split.first(4), config.model_copy(update={"workers": 0}), ANCHORS))
    assert len(beside) == len(alone) == 2
    for (images, targets), (own_images, own_targets) in zip(beside, alone, strict=True):
        assert torch.equal(images, own_images)
        for part, own in zip(targets, own_targets, strict=True):
            found, expected = ({key: one for key, one in vars(each).items() if one is not None} for each in (part, own))
            assert found.keys() == expected.keys() >= {"predictors", "boxes", "ignored"}
            assert all(torch.equal(value, expected[name]) for name, value in found.items())
