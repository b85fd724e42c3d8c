"""Training on sequences that a server renders: what they are, resuming, a server that is lost or does not fit."""

import re

import cv2
import numpy as np
import pytest
import torch
from tests.helpers.served import Served

from perilune_shared.config.resolve import resolve
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_train.data.epochs import DataLost
from perilune_train.data.frames import normalised
from perilune_train.data.shares import ALONE
from perilune_train.motion.config import NavigateConfig, StreamConfig
from perilune_train.motion.data.stream import Stream
from perilune_train.motion.data.streamed import StreamedSequences
from perilune_train.motion.data.trajectories import load_split
from perilune_train.motion.geometry import pixel_index_homography, plane_homography
from perilune_train.motion.train.navigate_run import navigate_run
from perilune_train.motion.train.task import NavigationTask
from perilune_train.records.provenance import TerrainUse, check_terrain, read_provenance
from perilune_train.training.runs import NamedRun

_NETWORK = {
    "size_px": 64,
    "width": 0.125,
    "hidden": 16,
    "sequence_pairs": 4,
    "batch_sequences": 2,
    "coarse_epochs": 0,
    "fine_epochs": 2,
    "learning_rate": 1e-3,
    "jitter": 1.0,
}


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    server = Served(tmp_path_factory.mktemp("server"))
    yield server
    server.stop()


@pytest.fixture(scope="module")
def dataset(dataset_nav):
    return open_dataset(dataset_nav)


def settings(address, **changes):
    stream = {"address": address, "n_scenes": 3, "pairs_per_scene": 12, "timeout_s": 20.0} | changes
    own = {"precision": "float32", "device": "cpu", "fusion": "warp", "warp": _NETWORK, "stack": _NETWORK}
    return NavigateConfig(**own, stream=StreamConfig(**stream))


def sequences(stream, dataset, **changes):
    """Plain sequences, so that frames can be compared with poses."""
    own = {"warp": False, "jitter": None, "seed": 3, "share": ALONE} | changes
    return StreamedSequences(stream, 96, load_split(dataset, "train"), 4, **own)


def test_a_rendered_sequence_has_the_motions_of_a_turned_part_of_a_training_trajectory(served, dataset):
    found = sequences(Stream(settings(served.address).stream, dataset), dataset)
    key = found.keys(0)[0]
    part, velocity, _ = found.poses(key)
    whole = found.trajectories[key[2]]
    frames = slice(key[3], key[3] + 5)
    np.testing.assert_allclose(part.position_m[:, 2], whole.position_m[frames, 2])
    radii = [np.linalg.norm(values[:, :2], axis=1) for values in (part.position_m, whole.position_m[frames])]
    np.testing.assert_allclose(*radii)
    assert np.abs(part.position_m - whole.position_m[frames]).max() > 1
    # The offsets from the nominal curve are turned with it, and so are the velocities.
    offsets = part.position_m - part.nominal_position_m, (whole.position_m - whole.nominal_position_m)[frames]
    np.testing.assert_allclose(*(np.linalg.norm(offset, axis=1) for offset in offsets))
    steps, speeds = np.diff(part.nominal_position_m, axis=0), velocity[:-1]
    cosine = (steps * speeds).sum(1) / np.linalg.norm(steps, axis=1) / np.linalg.norm(speeds, axis=1)
    assert (cosine > 0.99).all()
    sequence = found[key]
    np.testing.assert_allclose(sequence.translation_m, part.motion[0])
    np.testing.assert_allclose(sequence.rotation_c2_from_c1, part.motion[1])
    found.close()


def test_frames_show_the_motion_that_is_stated(served, dataset):
    """The later frame, laid onto the earlier one over the plane by the stated motion, is like it."""
    found = sequences(Stream(settings(served.address).stream, dataset), dataset)
    camera = found.trajectories[0].camera

    def likeness(sequence, part, pair, turn):
        down, height = -part.rotation_camera_from_site[pair][:, 2], part.position_m[pair, 2]
        motion = turn @ sequence.translation_m[pair], sequence.rotation_c2_from_c1[pair]
        homography = pixel_index_homography(plane_homography(camera.matrix, *motion, down, height))
        inverse = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        laid = cv2.warpPerspective(sequence.second[pair], homography, (96, 96), flags=inverse)
        middle = (slice(24, 72), slice(24, 72))
        return np.corrcoef(laid[middle].ravel(), sequence.first[pair][middle].ravel())[0, 1]

    for key in found.keys(0)[:2]:
        sequence, (part, _, _) = found[key], found.poses(key)
        stated, mirrored = (
            [likeness(sequence, part, pair, turn) for pair in range(4)] for turn in (np.eye(3), np.diag([-1, -1, 1]))
        )
        assert min(stated) > 0.8
        assert np.mean(stated) > np.mean(mirrored) + 0.2
    found.close()


def test_sequences_follow_from_the_seeds(served, dataset):
    def drawn(seed, epoch=0):
        found = sequences(Stream(settings(served.address, seed=seed).stream, dataset), dataset)
        keys = found.keys(epoch)[:3]
        taken = [found[key].first for key in keys]
        found.close()
        return keys, taken

    keys, first = drawn(0)
    _, again = drawn(0)
    assert all((one == other).all() for one, other in zip(first, again, strict=True))
    _, other = drawn(1)
    assert all((one != two).any() for one, two in zip(first, other, strict=True))
    assert drawn(0, epoch=1)[0] != keys


def test_scenes_change_after_their_pairs_and_a_share_is_rendered(served, dataset):
    found = sequences(Stream(settings(served.address).stream, dataset), dataset)
    assert found.counts == [2, 2, 2, 2]
    keys = [key for epoch in range(2) for key in found.keys(epoch)]
    # Twelve pairs are three sequences of four.
    assert [found.scene_of(key) for key in keys] == [1, 1, 1, 2, 2, 2, 3, 3, 3, 1, 1, 1, 2, 2, 2, 3]
    part = sequences(Stream(settings(served.address, share=0.25).stream, dataset), dataset)
    keys = part.keys(0)
    assert [part.is_rendered(key) for key in keys] == [False, False, False, True] * 2
    assert [part.scene_of(key) for key in keys if part.is_rendered(key)] == [1, 1]
    _, _, number, start = keys[0]
    frames = part.trajectories[number].images[start : start + 4]
    assert (part[keys[0]].first == np.stack([normalised(frame) for frame in frames])).all()
    found.close()
    part.close()


def leave_the_error(made):
    """Discard what was made ahead, which would be trained on first, until the error comes that ends it."""
    while not isinstance(found := made.get(timeout=30), BaseException):
        pass
    made.put(found)


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
def test_a_lost_server_ends_with_a_saved_state_that_resumes_to_the_same_weights(
    served, dataset_nav, tmp_path, monkeypatch, capsys
):
    (whole,) = navigate_run(settings(served.address), dataset_nav, NamedRun(tmp_path, "whole"), None)
    lost = Served(tmp_path)
    step, taken = NavigationTask.training_step, []

    def stops(self, batch, batch_idx):
        taken.append((self.current_epoch, batch_idx))
        if taken[-1] == (1, 1):
            lost.stop()
            leave_the_error(self.sequences._ahead._results)
        return step(self, batch, batch_idx)

    monkeypatch.setattr(NavigationTask, "training_step", stops)
    with pytest.raises(DataLost, match=r"got none in 5 s, expected .*run the same command again to resume") as error:
        navigate_run(settings(lost.address, timeout_s=5.0), dataset_nav, NamedRun(tmp_path, "lost"), None)
    assert "\n" not in str(error.value)
    saved = torch.load(tmp_path / "navigate/lost/checkpoints/last.ckpt", weights_only=True)
    assert saved["epoch_and_batches"] == [1, len(taken) - 4]
    assert 0 < len(taken) - 4 < 4
    begun = len(taken)
    # Another address is no other run.
    (resumed,) = navigate_run(settings(served.address), dataset_nav, NamedRun(tmp_path, "lost"), None)
    assert taken[begun] == (1, begun - 4)
    assert "resuming" in capsys.readouterr().err
    first, again = (torch.load(run.last, weights_only=True) for run in (whole, resumed))
    assert all(torch.equal(value, again["state_dict"][key]) for key, value in first["state_dict"].items())
    with pytest.raises(UserError, match=r"navigate\.stream\.share: got 0\.5, expected 1\.0"):
        navigate_run(settings(served.address, share=0.5), dataset_nav, NamedRun(tmp_path, "lost"), None)
    # The record of the terrain has what was rendered, before and after.
    for run in (whole, resumed):
        record = read_provenance(torch.load(run.best, weights_only=True), run.best)
        rendered = {use.scene_id for use in record.uses if use.dataset == "fresh (served)"}
        assert rendered == {"scene-0001", "scene-0002", "scene-0003"}
        assert {use.use for use in record.uses if use.dataset == "fresh (served)"} == {"trained"}
        assert check_terrain(record, open_dataset(dataset_nav)).status == "by protocol"


def test_a_run_is_not_resumed_over_other_terrain(served, dataset):
    stream = Stream(settings(served.address).stream, dataset)
    stream.load_state_dict([[1, "fresh (served)", "scene-0001", "trained", "0" * 64, "fresh (served)"]])
    found = sequences(stream, dataset)
    with pytest.raises(DataLost, match=r"scene 1: got terrain [0-9a-f]{12} of fresh \(served\), expected 0{12} of"):
        found[found.keys(0)[0]]
    found.close()


def test_terrain_of_a_held_out_scene_is_refused(served, dataset):
    stream = Stream(settings(served.address).stream, dataset)
    with stream.client() as client:
        ground = client.ground(1)
    stream._held_out = frozenset({TerrainUse("test", "s001", "selected", ground.content_sha256, "test")})
    found = sequences(stream, dataset)
    with pytest.raises(DataLost, match=r"scene 1: got the terrain of s001 of the dataset \(selected\)"):
        found[found.keys(0)[0]]
    assert stream.uses == frozenset()
    found.close()


def test_a_server_that_does_not_fit_is_an_error_and_leaves_no_run(served, dataset_nav, make_dataset, tmp_path):
    small = {split: 1 for split in ("train", "val", "test")}
    other = make_dataset(tmp_path / "other", "nav", splits=small, side_px=64, n_frames=3, craters=10)
    for address, changes, place, message in (
        (served.address, {"n_scenes": 5}, dataset_nav, r"--scenes: got 5, expected at least 6"),
        ("tcp://127.0.0.1:9", {"timeout_s": 0.3}, dataset_nav, r"tcp://127.0.0.1:9: reply: got none in 0.3 s"),
        ("nowhere", {}, dataset_nav, r"client: address: got nowhere"),
    ):
        with pytest.raises(UserError, match=message):
            navigate_run(settings(address, **changes), place, NamedRun(tmp_path, "none"), None)
    assert not (tmp_path / "navigate").exists()
    # The same view in fewer pixels fits: frames are shrunk to those of the network.
    assert Stream(settings(served.address).stream, open_dataset(other)).served.camera.width_px == 96
    wide = open_dataset(other)
    record = wide.info.camera.model_copy(update={"fx_px": 2 * wide.info.camera.fx_px})
    object.__setattr__(wide, "info", wide.info.model_copy(update={"camera": record}))
    with pytest.raises(UserError, match=r"camera: got Camera\(width_px=96"):
        Stream(settings(served.address).stream, wide)


@pytest.mark.parametrize("setting", ["navigate.fusion=both", "navigate.fusion=stack", "navigate.workers=2"])
def test_streaming_is_for_warp_in_the_training_process(setting):
    own = ("navigate.fusion=warp", "navigate.stream.address=tcp://127.0.0.1:10364", "navigate.stream.n_scenes=9")
    found = resolve(NavigateConfig, "navigate", "perilune_train", "tiny", None, own)
    assert found.stream == StreamConfig(address="tcp://127.0.0.1:10364", n_scenes=9)
    with pytest.raises(UserError, match=re.escape("fusion=warp and workers=0, since stream is given")):
        resolve(NavigateConfig, "navigate", "perilune_train", "tiny", None, (*own, setting))
