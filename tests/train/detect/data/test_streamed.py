"""The detector trains on a stream of packed frames: the same samples as in memory, resumed within an epoch."""

import itertools
import shutil

import numpy as np
import pytest
import torch
from tests.helpers.hostile import rewrite

from perilune_shared.config.resolve import resolve
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.editing import pack as packing
from perilune_shared.editing.pack import pack
from perilune_shared.errors import UserError
from perilune_shared.storage.store import open_store
from perilune_train.data.shares import ALONE
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data import streamed
from perilune_train.detect.data.batches import TrainingFrames
from perilune_train.detect.data.split import load_split
from perilune_train.detect.data.streamed import open_streamed, streamed_loader
from perilune_train.detect.train.detect_run import run_detect
from perilune_train.detect.train.task import DetectTask

QUICK = ("detect.epochs=2", "detect.width=0.125", "detect.precision=float32", "detect.device=cpu", "detect.stream=true")


def settings(*more):
    return resolve(DetectConfig, "detect", "perilune_train", "tiny", None, (*QUICK, *more))


@pytest.fixture(scope="module")
def packed(few, tmp_path_factory):
    """The dataset `few` in row groups of two frames, with six training frames. Do not change it."""
    out = tmp_path_factory.mktemp("streamed") / "packed"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(packing, "_FRAMES_PER_GROUP", 2)
        pack(open_dataset(few), out)
    return out


def test_samples_are_those_of_frames_in_memory(few, packed):
    config = settings("detect.batch_size=1", "detect.augment.scale=[0.8, 1.25]")
    memory = TrainingFrames(load_split(open_dataset(few), "train", config.labels, config.augment.scale), config)
    split = open_streamed(open_dataset(packed), config, ALONE)
    assert sorted(split.label_sizes_px.tolist()) == sorted(memory.split.label_sizes_px.tolist())
    assert split.radius_px == memory.split.radius_px
    streamed_loader(split, config, torch.ones(3, 3, 2))
    split.stream.set_epoch(3)
    make = split.stream.make
    split.stream.make = lambda frames, epoch: [(frame.number, make.sample(frame, epoch)) for frame in frames]
    numbers = []
    for number, sample in itertools.chain.from_iterable(split.stream):
        numbers.append(number)
        for value, expected in zip(sample, memory[3, number], strict=True):
            assert np.array_equal(value, expected)
    assert sorted(numbers) == list(range(6)) != numbers


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
@pytest.mark.parametrize("workers", [0, 2])
def test_a_run_stopped_within_an_epoch_is_resumed_with_the_frames_that_were_left(
    packed, tmp_path, workers, monkeypatch
):
    monkeypatch.setattr("perilune_train.detect.train.detect_run.evaluate", lambda *_: {})
    quick = ("detect.batch_size=1", f"detect.workers={workers}")
    # Only the run that is stopped writes a checkpoint after every batch.
    config = settings(*quick, "detect.checkpoint_minutes=0")
    seen, original = [], DetectTask.training_step

    def recorded(self, batch, batch_idx):
        if len(seen) == stop_after:
            raise KeyError("killed")
        seen.append((self.current_epoch, batch[0].sum().item()))
        return original(self, batch, batch_idx)

    monkeypatch.setattr(DetectTask, "training_step", recorded)
    stop_after = None
    whole = run_detect(settings(*quick), packed, tmp_path, "whole")
    expected = list(seen)
    assert len(expected) == len(set(expected)) == 12
    seen, stop_after = [], 9
    with pytest.raises(KeyError):
        run_detect(config, packed, tmp_path, "killed")
    assert seen == expected[:9]
    other = settings("detect.batch_size=1", "detect.checkpoint_minutes=0", "detect.workers=3")
    with pytest.raises(
        UserError, match=r"state of the stream: workers: got 3, expected \d, as when the state was saved"
    ):
        run_detect(other, packed, tmp_path, "killed")
    seen, stop_after = [], None
    run = run_detect(config, packed, tmp_path, "killed")
    assert seen == expected[9:]
    first, again = (torch.load(each.last, weights_only=True)["state_dict"] for each in (whole, run))
    assert first.keys() == again.keys() and all(torch.equal(first[key], again[key]) for key in first)


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
def test_a_run_on_an_object_store_gives_the_same_weights(packed, s3_bucket, tmp_path, monkeypatch):
    monkeypatch.setattr("perilune_train.detect.train.detect_run.evaluate", lambda *_: {})
    source, target = open_store(packed), open_store(f"{s3_bucket}/packed")
    for item in source.list():
        target.write(item.path, source.read(item.path))
    config = settings("detect.epochs=1")
    made = [run_detect(config, place, tmp_path, name) for name, place in (("a", packed), ("b", target.address))]
    first, again = (torch.load(run.last, weights_only=True)["state_dict"] for run in made)
    assert all(torch.equal(first[key], again[key]) for key in first)
    assert (
        made[0].inputs.read_text() == made[1].inputs.read_text()
        and "null" not in made[1].inputs.read_text().split(",")[0]
    )


def test_only_packed_datasets_are_streamed(few, tmp_path):
    with pytest.raises(UserError, match="few: images: got files, expected packed; see `perilune-manifest pack`"):
        run_detect(settings(), few, tmp_path, "a")
    assert not list(tmp_path.iterdir())


def test_a_label_without_a_crater_is_refused(packed, tmp_path):
    root = shutil.copytree(packed, tmp_path / "set")
    rewrite(root, "craters", lambda rows: rows.clear())
    with pytest.raises(UserError, match=r"set: labels: crater_id: got \d+ in s.*, expected craters; see"):
        open_streamed(open_dataset(root), settings(), ALONE)


def test_craters_of_few_scenes_are_kept(packed, monkeypatch):
    monkeypatch.setattr(streamed, "_MAX_SCENES", 1)
    config, read = settings("detect.batch_size=1"), []
    split = open_streamed(open_dataset(packed), config, ALONE)
    original = streamed.read_craters
    monkeypatch.setattr(streamed, "read_craters", lambda data, scene: read.append(scene) or original(data, scene))
    loader = streamed_loader(split, config, torch.ones(3, 3, 2))
    assert len(list(loader)) == 6 and set(read) == {"s000", "s001", "s002"}
    assert len(split.stream.make.labels.scenes) == 1
