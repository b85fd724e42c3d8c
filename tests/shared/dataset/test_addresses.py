"""Datasets are read from an S3 server and from memory as from a local folder."""

import numpy as np
import pytest
from tests.helpers import in_process
from tests.helpers.s3_server import uploaded

from perilune_shared.cli.main import main
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.editing.diff import differences
from perilune_shared.editing.subset import subset
from perilune_shared.errors import UserError
from perilune_shared.export.stats import summary
from perilune_shared.storage.store import open_store
from perilune_shared.validation.validate import validate


@pytest.fixture(params=["memory", "s3"])
def address(request, tmp_path) -> str:
    return f"{request.getfixturevalue('s3_bucket')}/a/moon" if request.param == "s3" else f"memory://{tmp_path.name}"


def test_a_dataset_is_read_from_an_address(crowded, address):
    local, remote = open_dataset(crowded), open_dataset(uploaded(crowded, address))
    assert validate(remote) == [] and differences(local, remote) == []
    assert summary(remote).equals(summary(local))
    for place in (0, -1, "s001/t001/000003"):
        assert np.array_equal(remote[place].image, local[place].image)
        assert remote[place].labels.equals(local[place].labels)
    columns = ["frame_id", "radius_px"]
    assert remote.table("labels", columns, split="test").equals(local.table("labels", columns, split="test"))


def test_packed_frames_are_read_from_an_address(crowded_packed, address):
    remote = open_dataset(uploaded(crowded_packed, address))
    assert validate(remote) == []
    assert np.array_equal(remote[7].image, open_dataset(crowded_packed)[7].image)


def test_damage_at_an_address_is_found(little, address):
    store = open_store(uploaded(little, address))
    store.delete("frames/s000/t000/000001.png")
    store.write("frames/s000/t000/notes.txt", b"x")
    store.replace("frames/s000/t000/000002.png", b"x")
    found = {(fault.file, fault.column) for fault in validate(open_dataset(address))}
    assert {
        ("frames/s000/t000/000001.png", "png_path"),
        ("frames/s000/t000/notes.txt", "file"),
        ("frames/s000/t000/000002.png", "png_bytes"),
    } <= found
    with pytest.raises(UserError, match=rf"{address}/frames/s000/t000/000001.png: file: got no such file"):
        open_dataset(address)["s000/t000/000001"]


def test_a_subset_of_a_dataset_at_an_address(little, address, tmp_path):
    subset(open_dataset(uploaded(little, address)), tmp_path / "local", where=["split == 'train'"])
    made = open_dataset(tmp_path / "local")
    assert validate(made) == [] and len(made) == 3
    assert np.array_equal(made[0].image, open_dataset(little)[0].image)


def test_an_empty_address_is_no_dataset(address):
    with pytest.raises(UserError, match=rf"{address}: dataset.json: got no such file"):
        open_dataset(address)


@pytest.mark.parametrize("command", ["validate", "stats"])
def test_commands_take_an_address(command, little, s3_bucket):
    done = in_process.call(main, command, uploaded(little, f"{s3_bucket}/moon"))
    assert done.returncode == 0 and ("no fault" if command == "validate" else "6 frames") in done.stdout


@pytest.mark.slow
def test_card_and_croissant_become_files_of_a_dataset_at_an_address(little, s3_bucket):
    address = uploaded(little, f"{s3_bucket}/moon")
    done = in_process.call(main, "card", address)
    assert done.returncode == 0 and f"{address}/README.md, {address}/card.png: written" in done.stdout, done.stderr
    done = in_process.call(main, "export", address, "--format", "croissant")
    assert done.returncode == 0 and f"{address}/croissant.json: written" in done.stdout
    assert in_process.call(main, "card", address).returncode == 0  # again, over the old one
    dataset, local = open_dataset(address), open_dataset(little)
    assert validate(dataset) == [] and differences(dataset, local) == []
    assert {"README.md", "card.png", "croissant.json"} <= {item.path for item in dataset.store.list()}
    within = in_process.call(main, "card", address, "--out", f"{address}/manifest/card.md")
    assert within.returncode == 2 and "expected a file directly in the dataset" in within.stderr
    outside = in_process.call(main, "card", address, "--out", f"{s3_bucket}/pages/moon.md")
    assert outside.returncode == 0, outside.stderr
    assert {item.path for item in open_store(f"{s3_bucket}/pages").list()} == {"moon.md", "moon.png"}


@pytest.mark.parametrize("format", ["coco", "yolo", "tum", "kitti", "huggingface"])
def test_exports_are_written_to_an_address(format, little, s3_bucket, tmp_path):
    source, out = uploaded(little, f"{s3_bucket}/moon"), f"{s3_bucket}/{format}"
    for dataset, to in ((source, out), (little, tmp_path / "local")):
        done = in_process.call(main, "export", dataset, "--format", format, "--out", to)
        assert done.returncode == 0, done.stderr
    remote, local = (
        {item.path: store.read(item.path) for item in store.list()}
        for store in map(open_store, (out, tmp_path / "local"))
    )
    assert remote and remote == local
    again = in_process.call(main, "export", source, "--format", format, "--out", out)
    assert again.returncode == 2 and f"error: {out}: --out: got an address that is not empty" in again.stderr
