"""The stream of packed frames: each frame once, in a repeatable order, resumed at any batch, in little memory."""

import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from perilune_shared.dataset import parts
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.dataset.packed import SHARDS
from perilune_shared.editing import pack as packing
from perilune_shared.editing.pack import pack
from perilune_shared.errors import UserError
from perilune_shared.storage.store import ObjectStore, open_store
from perilune_train.data import stream as streaming
from perilune_train.data.shares import Share
from perilune_train.data.stream import FrameStream, StreamLoader

N_FRAMES = 35


@pytest.fixture(scope="module")
def packed(make_dataset, tmp_path_factory):
    """35 training frames in three or more shards, with row groups of at most 3 frames. Do not change it."""
    folder = tmp_path_factory.mktemp("stream")
    splits = {"train": 5, "val": 1, "test": 1}
    root = make_dataset(folder / "files", "detect", side_px=32, splits=splits, n_frames=7, craters=60)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(packing, "_FRAMES_PER_GROUP", 3)
        pack(open_dataset(root), folder / "packed", shard_mb=0.008)
    assert len(open_dataset(folder / "packed").shards("train")) >= 3
    return folder / "packed"


def frame_ids(batch, epoch):
    return [frame.row["frame_id"] for frame in batch]


def loader_of(root, process=0, processes=1, workers=0, seed=0, batch_size=4):
    stream = FrameStream(open_dataset(root), "train", batch_size, seed, Share(process, processes))
    stream.make = frame_ids
    return StreamLoader(stream, workers)


def epoch_of(root, epoch=0, **options):
    """All batches of an epoch, as lists of frame_ids."""
    loader = loader_of(root, **options)
    loader.sampler.set_epoch(epoch)
    return list(loader)


@pytest.mark.parametrize("workers", [0, 1, 2])
@pytest.mark.parametrize("processes", [1, 2, 3])
def test_each_frame_comes_once_in_an_epoch(packed, processes, workers):
    expected = open_dataset(packed).table("frames", split="train")["frame_id"].to_pylist()
    assert len(expected) == N_FRAMES
    for batch_size in (1, 4):
        shares = [epoch_of(packed, 0, process=k, processes=processes, workers=workers, batch_size=batch_size)
                  for k in range(processes)]  # fmt: skip
        assert len({len(batches) for batches in shares}) == 1
        assert {len(batch) for batches in shares for batch in batches[:-1]} == {batch_size}
        assert all(1 <= len(batches[-1]) <= batch_size + 1 for batches in shares)
        assert sorted(name for batches in shares for batch in batches for name in batch) == sorted(expected)


def test_the_order_depends_on_seed_and_epoch_only(packed):
    first = epoch_of(packed)
    assert epoch_of(packed) == first
    others = [epoch_of(packed, 1), epoch_of(packed, seed=1)]
    names = [[name for batch in batches for name in batch] for batches in (first, *others)]
    assert len({tuple(order) for order in (*names, sorted(names[0]))}) == 4
    # Not only row groups are permuted: neighbours of the dataset are seldom neighbours of the stream.
    places = np.array([sorted(names[0]).index(name) for name in names[0]])
    assert (np.abs(np.diff(places)) == 1).sum() < N_FRAMES / 4


def test_epochs_of_one_loader_follow_each_other(packed):
    loader = loader_of(packed, workers=1)
    for epoch in range(2):
        loader.sampler.set_epoch(epoch)
        assert len(loader) == 9 and list(loader) == epoch_of(packed, epoch)


@pytest.mark.parametrize("workers", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_a_stream_is_resumed_with_exactly_the_batches_that_were_left(packed, workers, monkeypatch):
    monkeypatch.setattr(streaming, "_GROUPS_PER_WINDOW", 2)
    options = {"process": 1, "processes": 2, "workers": workers, "batch_size": 3}
    whole = epoch_of(packed, 5, **options)
    following = epoch_of(packed, 6, **options)
    assert len(whole) == 6
    for done in range(len(whole) + 1):
        loader = loader_of(packed, **options)
        loader.sampler.set_epoch(5)
        batches = iter(loader)
        assert [next(batches) for _ in range(done)] == whole[:done]
        state = loader.stream.state_dict()
        again = loader_of(packed, **options)
        again.stream.load_state_dict(state)
        again.sampler.set_epoch(5)
        assert list(again) == whole[done:]
        again.sampler.set_epoch(6)
        assert list(again) == following


def test_a_state_of_another_stream_is_refused_in_one_line(packed):
    state = loader_of(packed, workers=2).stream.state_dict()
    for options in ({"workers": 1}, {"workers": 2, "seed": 1}, {"workers": 2, "processes": 2}):
        with pytest.raises(
            UserError, match=r"state of the stream: (workers|seed|processes): got .* when the state was"
        ):
            loader_of(packed, **options).stream.load_state_dict(state)


def test_frames_have_their_rows_images_and_labels(packed):
    dataset = open_dataset(packed)
    numbers, n_labels = [], 0
    for batch in FrameStream(dataset, "train", 4, seed=0):
        for frame in batch:
            expected = dataset[frame.row["frame_id"]]
            assert frame.png == expected.png and frame.row["position_m"] == expected.row["position_m"].tolist()
            labels = pa.Table.from_struct_array(frame.labels).to_pandas()
            assert labels.equals(expected.labels[labels.columns].reset_index(drop=True))
            n_labels += len(labels)
            numbers.append(frame.number)
    assert sorted(numbers) == list(range(N_FRAMES))
    assert n_labels == len(dataset.table("labels", split="train")) > 0


def truncated(path):
    path.write_bytes(path.read_bytes()[:-30])


def damaged_page(path):
    content = bytearray(path.read_bytes())
    column = pq.read_metadata(path).row_group(1).column(0)
    content[column.data_page_offset : column.data_page_offset + 40] = bytes(40)
    path.write_bytes(content)


@pytest.mark.parametrize("workers", [0, 1])
@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (truncated, "content: got .*, expected a complete Parquet file"),
        (damaged_page, "content: got .*, expected a complete Parquet file"),
        (lambda path: path.unlink(), "shard: got no such file, expected one of the . shards of the split train"),
    ],
)
def test_damaged_shards_are_refused_in_one_line(packed, tmp_path, damage, message, workers):
    root = shutil.copytree(packed, tmp_path / "set")
    path = root / open_dataset(root).shards("train")[1]
    damage(path)
    with pytest.raises(UserError, match=message) as caught:
        epoch_of(root, workers=workers)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


@pytest.mark.parametrize("workers", [0, 2])
def test_a_stream_from_an_object_store_is_the_same(packed, s3_bucket, workers):
    copied(packed, f"{s3_bucket}/packed")
    assert epoch_of(f"{s3_bucket}/packed", 1, workers=workers) == epoch_of(packed, 1, workers=workers)
    store = open_store(f"{s3_bucket}/packed")
    first, last = open_dataset(store).shards("train")[0], open_dataset(store).shards("train")[-1]
    loader = loader_of(store, workers=workers)
    store.replace(first, store.read(first)[:-30])
    with pytest.raises(UserError, match=rf"{store.at(first)}: content: got .*, expected a complete Parquet file"):
        list(loader)
    store.delete(last)
    with pytest.raises(UserError, match=rf"{store.at(last)}: shard: got no such file"):
        loader_of(store)


def test_a_row_group_of_an_object_store_is_read_by_one_request(packed, s3_bucket, monkeypatch):
    # Files this small are otherwise read whole.
    monkeypatch.setattr(parts, "_SMALL_BYTES", 1000)
    copied(packed, f"{s3_bucket}/packed")
    dataset, read, original = open_dataset(f"{s3_bucket}/packed"), [], ObjectStore.read

    def recorded(store, path, *span, **options):
        content = original(store, path, *span, **options)
        read.append((path, len(content)))
        return content

    stream = FrameStream(dataset, "train", 4, seed=0)
    expected = [frame_ids(batch, 0) for batch in FrameStream(open_dataset(packed), "train", 4, seed=0)]
    monkeypatch.setattr(ObjectStore, "read", recorded)
    assert [frame_ids(batch, 0) for batch in stream] == expected
    shards = set(stream._groups.shard)
    # The end of a shard is read for its footer, here by two requests, since the footer is longer than 1000 bytes.
    assert len(shards) >= 3 and len(read) == len(stream._groups.shard) + 2 * len(shards)


def copied(folder, address):
    """Copy a dataset from a folder to an address."""
    source, target = open_store(folder), open_store(address)
    for item in source.list():
        target.write(item.path, source.read(item.path))


def test_other_datasets_are_refused(packed, few):
    with pytest.raises(UserError, match="few: images: got files, expected packed; see `perilune-manifest pack`"):
        loader_of(few)
    with pytest.raises(UserError, match="train frames: got 35, expected at least 36, one for each process"):
        loader_of(packed, processes=36)


def test_only_two_windows_are_in_memory(packed, tmp_path, monkeypatch):
    """60 row groups of 1 MB, of which a window has 4."""
    monkeypatch.setattr(streaming, "_GROUPS_PER_WINDOW", 4)
    root = shutil.copytree(packed, tmp_path / "set")
    first, *others = open_dataset(root).shards("train")
    row = pq.read_table(root / first, schema=SHARDS).slice(0, 1).to_pylist()[0]
    for path in (first, *others):
        (root / path).unlink()
    rng = np.random.default_rng(0)
    with pq.ParquetWriter(
        root / "shards/train-00000-of-00001.parquet", SHARDS, compression="none", use_dictionary=["frame_id"]
    ) as writer:
        for _ in range(60):
            rows = [{**row, "image": {"bytes": rng.bytes(250_000), "path": "a"}} for _ in range(4)]
            writer.write_table(pa.Table.from_pylist(rows, schema=SHARDS))
    loader = loader_of(root)
    before, most = pa.total_allocated_bytes(), 0
    for _ in loader:
        most = max(most, pa.total_allocated_bytes() - before)
    # Two windows, and the row groups that are being read and decoded at that moment.
    assert 4e6 < most < 3.5 * 4e6
