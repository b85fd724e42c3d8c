"""Training frames that a server renders: their poses, Suns and labels, and a server that does not fit."""

import re

import numpy as np
import pandas as pd
import pytest
from tests.helpers.served import Served

from perilune_shared.client import SceneClient
from perilune_shared.config.resolve import resolve
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import matrix_from_quaternion, quaternion_from_matrix, sun_direction
from perilune_shared.labels.selection import selected
from perilune_train.data.epochs import DataLost
from perilune_train.data.frames import normalised
from perilune_train.data.shares import ALONE, Share
from perilune_train.detect.config import DetectConfig, FreshConfig
from perilune_train.detect.data.fresh import FreshFrames, FreshServer
from perilune_train.detect.data.split import load_split
from perilune_train.records.provenance import TerrainUse

PLAIN = (
    "detect.augment={flips_and_turns: false, gain: 0.0, gamma: 0.0, blur_px: 0.0, noise: 0.0}",
    "detect.device=cpu",
    "detect.batch_size=4",
)


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    server = Served(tmp_path_factory.mktemp("server"))
    yield server
    server.stop()


def settings(address, *more, **changes):
    """Settings without augmentation, so that frames can be compared with poses."""
    fresh = {"address": address, "n_scenes": 3, "frames_per_scene": 6, "timeout_s": 20.0} | changes
    chosen = resolve(DetectConfig, "detect", "perilune_train", "tiny", None, (*PLAIN, *more))
    return chosen.model_copy(update={"fresh": FreshConfig(**fresh)})


@pytest.fixture
def opened(served, dataset_detect):
    """A function that opens the frames of the settings with changes; all are closed at the end."""
    made = []

    def frames(*more, share=ALONE, **changes):
        config, dataset = settings(served.address, *more, **changes), open_dataset(dataset_detect)
        split = load_split(dataset, "train", config.labels, config.augment.scale, share)
        made.append(FreshFrames(split, config, dataset, FreshServer(config.fresh, dataset)))
        return made[-1]

    yield frames
    for each in made:
        each.close()


def test_a_view_is_a_training_pose_turned_about_the_vertical_towards_the_sun(opened):
    frames = opened()
    for key in frames.keys(0)[:8]:
        view, row = frames.view(key), frames.split.frames.table.iloc[key[1]]
        before = matrix_from_quaternion(row["rotation_wxyz"])
        turn = view.rotation_camera_from_site.T @ before
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(turn[2], [0, 0, 1], atol=1e-12)
        np.testing.assert_allclose(view.position_m, turn @ row["position_m"])
        # The ground is square, so only quarter turns keep the corners of every frame on it.
        np.testing.assert_allclose(np.abs(turn).max(1), 1, atol=1e-9)
        assert view.sun_deg[1] == pytest.approx(30)  # as in all scenes of the dataset
        # Seen from the camera, the Sun's azimuth is within 45 degrees of the training frame's.
        (x0, y0), (x1, y1) = (turn.T @ sun_direction(*view.sun_deg))[:2], row["sun_direction"][:2]
        assert x0 * x1 + y0 * y1 >= np.cos(np.radians(45)) * np.hypot(x0, y0) * np.hypot(x1, y1) - 1e-9
        np.testing.assert_allclose(view.velocity_mps, turn @ frames._velocity_mps[key[1]])
        # The farthest |x| or |y| that a corner of the image shows on level ground stays.
        rays = frames.server.served.camera.rays([[0.0, 0.0], [96.0, 0.0], [0.0, 96.0], [96.0, 96.0]])
        reach = [
            np.abs(place - (rays @ rotation) / (rays @ rotation)[:, 2:] * place[2])[:, :2].max()
            for place, rotation in ((view.position_m, view.rotation_camera_from_site), (row["position_m"], before))
        ]
        assert reach[0] == pytest.approx(reach[1])
    keys = [key for epoch in range(4) for key in frames.keys(epoch)]
    assert len({tuple(np.round(frames.view(key).rotation_camera_from_site.ravel())) for key in keys}) == 4
    assert len({frames.view(key).index for key in frames.keys(0)}) == 24


def test_suns_belong_to_visits_and_visits_to_positions(opened):
    frames = opened()
    keys = [key for epoch in range(2) for key in frames.keys(epoch)]
    assert [frames.visit_of(key) for key in keys] == [place // 6 for place in range(48)]
    suns = [frames.view(key).sun_deg for key in keys]
    assert [suns[place] == suns[place - 1] for place in range(1, 48)] == [place % 6 != 0 for place in range(1, 48)]
    assert [frames.server.scene_of(frames.visit_of(key)) for key in keys[::6]] == [1, 2, 3, 1, 2, 3, 1, 2]


def test_a_share_of_the_frames_is_rendered(opened):
    frames = opened(share=ALONE, **{"frames_per_scene": 4})
    part = opened("detect.seed=0", share=ALONE)
    part.server.settings = part.server.settings.model_copy(update={"share": 0.25})
    keys = part.keys(0)
    rendered = [part.server.is_rendered(key[2]) for key in keys]
    assert rendered == [False, False, False, True] * 6
    assert [part.visit_of(key) for key, drawn in zip(keys, rendered, strict=True) if drawn] == [0] * 6
    pixels, outlines, chosen = part[keys[0]]
    number = keys[0][1]
    assert np.array_equal(pixels, normalised(part.split.frames.images[number].astype(np.float32)))
    assert np.array_equal(outlines, part.split.labels[number].outlines)
    assert np.array_equal(chosen, part.split.labels[number].selected)
    assert (part[keys[3]][0] != normalised(part.split.frames.images[keys[3][1]].astype(np.float32))).any()
    assert frames.keys(0) == keys


def test_labels_are_the_servers_with_the_selection_of_stored_frames(opened, served):
    frames = opened()
    for key in frames.keys(0)[:3]:
        pixels, outlines, chosen = frames[key]
        view, scene = frames.view(key), frames.server.scene_of(frames.visit_of(key))
        with SceneClient(served.address) as client:
            motion = {"velocity_mps": view.velocity_mps, "sun_deg": view.sun_deg, "index": view.index}
            rotation = quaternion_from_matrix(view.rotation_camera_from_site)
            frame = client.frame(view.position_m, rotation, **motion, labels=True, scene=scene)
            craters = pd.DataFrame(client.craters(scene))
        assert np.array_equal(pixels, normalised(frame.image.astype(np.float32)))
        labels = pd.DataFrame(frame.labels).merge(craters[["crater_id", "depth_m", "diameter_m"]], on="crater_id")
        seen = selected(labels, frames.limits.selection)
        assert 0 < seen.sum() < len(seen) < len(outlines)
        boxes = labels[["bbox_x0_px", "bbox_y0_px", "bbox_x1_px", "bbox_y1_px"]].to_numpy(np.float64)
        assert sorted(map(tuple, outlines[chosen, :4])) == sorted(map(tuple, boxes[seen]))


def test_walls_that_face_the_sun_are_bright_in_the_rendered_frames(opened):
    """Image, labels, pose and Sun of a frame belong together."""
    frames, differences = opened(), []
    for key in frames.keys(0)[:6]:
        pixels, outlines, chosen = frames[key]
        view = frames.view(key)
        towards = (view.rotation_camera_from_site @ sun_direction(*view.sun_deg))[:2]
        towards /= np.linalg.norm(towards)
        v, u = np.mgrid[:96, :96] + 0.5
        for x0, y0, x1, y1 in outlines[chosen, :4]:
            dx, dy, radius = u - (x0 + x1) / 2, v - (y0 + y1) / 2, np.sqrt((x1 - x0) * (y1 - y0)) / 2
            inside, along = np.hypot(dx, dy) < 0.8 * radius, dx * towards[0] + dy * towards[1]
            if radius > 4:
                differences.append(pixels[inside & (along < 0)].mean() - pixels[inside & (along > 0)].mean())
    assert len(differences) > 10
    assert np.mean(np.array(differences) > 0) > 0.9


def test_frames_follow_from_the_seed(opened):
    def drawn(seed, epoch=0):
        frames = opened(seed=seed)
        return [frames[key][0] for key in frames.keys(epoch)[:2]]

    first, again, other = drawn(0), drawn(0), drawn(1)
    assert all(np.array_equal(one, two) for one, two in zip(first, again, strict=True))
    assert not any(np.array_equal(one, two) for one, two in zip(first, other, strict=True))
    assert not any(np.array_equal(one, two) for one, two in zip(first, drawn(0, epoch=1), strict=True))


def test_two_processes_render_the_frames_of_one(opened):
    whole, parts = opened(), [opened(share=Share(process, 2)) for process in range(2)]
    keys = {key[2]: key for key in whole.keys(1)}
    own = [part.keys(1) for part in parts]
    assert sorted(key[2] for part in own for key in part) == sorted(keys)
    for part, part_keys in zip(parts, own, strict=True):
        key = part_keys[3]
        for value, expected in zip(part[key], whole[keys[key[2]]], strict=True):
            assert np.array_equal(value, expected)


def test_frames_ahead_end_with_the_training(opened):
    frames = opened("detect.epochs=2")
    ahead = list(frames._following(frames.keys(1)[20]))
    assert [key[:1] + key[2:] for key in ahead] == [(1, position) for position in range(20, 24)]


def test_terrain_of_a_held_out_scene_is_refused(opened, served):
    frames = opened()
    with SceneClient(served.address) as client:
        rendered = client.ground(1).content_sha256
    for use in ("selected", "tested"):
        frames.server._held_out = frozenset({TerrainUse("other", "s003", use, rendered, "other")})
        with pytest.raises(DataLost, match=rf"scene 1: got the terrain of s003 of the dataset \({use}\)"):
            frames[frames.keys(0)[0]]
    assert frames.server.uses == frozenset()


def test_a_run_is_not_resumed_over_other_terrain(opened):
    frames = opened()
    frames.server.load_state_dict([[1, "fresh (served)", "scene-0001", "trained", "0" * 64, "fresh (served)"]])
    with pytest.raises(DataLost, match=r"scene 1: got terrain [0-9a-f]{12} of fresh \(served\), expected 0{12} of"):
        frames[frames.keys(0)[0]]


def test_replies_without_a_column_are_refused(opened, monkeypatch):
    craters = SceneClient.craters

    def damaged(self, scene=0):
        columns = craters(self, scene)
        return {name: values for name, values in columns.items() if name != "depth_m"}

    monkeypatch.setattr(SceneClient, "craters", damaged)
    frames = opened()
    with pytest.raises(DataLost, match=r"craters of scene 1: depth_m: got no such column, expected a column") as error:
        frames[frames.keys(0)[0]]
    assert "\n" not in str(error.value)
    monkeypatch.setattr(SceneClient, "craters", lambda self, scene=0: {**craters(self, scene), "x_m": np.zeros(2)})
    frames = opened()
    with pytest.raises(DataLost, match=r"craters of scene 1: \w+: got .*, expected a column of equal length"):
        frames[frames.keys(0)[0]]


@pytest.mark.parametrize(
    ("address", "changes", "message"),
    [
        (None, {"n_scenes": 5}, "--scenes: got 5, expected at least 6, detect.fresh.n_scenes and scene 0"),
        ("tcp://127.0.0.1:9", {"timeout_s": 0.3}, "tcp://127.0.0.1:9: reply: got none in 0.3 s"),
        ("nowhere", {}, "client: address: got nowhere"),
    ],
)
def test_a_server_that_is_absent_or_has_too_few_scenes_is_refused(served, dataset_detect, address, changes, message):
    config = settings(address or served.address, **changes)
    with pytest.raises(UserError, match=re.escape(message)) as error:
        FreshServer(config.fresh, open_dataset(dataset_detect))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sensor": {"bits": 12}}, r"image: got uint16 \(96, 96\), expected uint8 \(96, 96\): dataset.sensor.bits 8"),
        (
            {"camera": {"width_px": 128, "height_px": 128, "horizontal_fov_deg": 40.0}},
            "image size: got 128 x 128 px, expected 96 x 96 px, as in the dataset",
        ),
        (
            {"camera": {"width_px": 96, "height_px": 96, "horizontal_fov_deg": 50.0}},
            r"camera: got Camera\(width_px=96.* expected Camera\(width_px=96",
        ),
        (
            {"scene": {"views": [{"height_m": 300, "reach_m": 400}, {"height_m": 1600, "reach_m": 700}]}},
            r"extent of the ground: got 14\d\d.\d m, expected at least 2800.0 m, as the dataset",
        ),
    ],
)
def test_a_server_of_another_scene_or_sensor_is_refused_before_training(dataset_detect, tmp_path, changes, message):
    server = Served(tmp_path, 4, **changes)
    try:
        with pytest.raises(UserError, match=message) as error:
            FreshServer(settings(server.address).fresh, open_dataset(dataset_detect))
    finally:
        server.stop()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("setting", ["detect.stream=true", "detect.workers=2"])
def test_fresh_frames_are_made_in_the_training_process(setting):
    own = ("detect.fresh.address=tcp://127.0.0.1:10364",)
    found = resolve(DetectConfig, "detect", "perilune_train", "tiny", None, own)
    assert found.fresh == FreshConfig(address="tcp://127.0.0.1:10364") and found.fresh.n_scenes == 1000
    with pytest.raises(UserError, match=re.escape("stream=false and workers=0, since fresh is given")):
        resolve(DetectConfig, "detect", "perilune_train", "tiny", None, (*own, setting))
