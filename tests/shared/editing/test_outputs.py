"""The editing tools write to an S3 server and to memory as to a local folder."""

import pytest
from tests.helpers import in_process

from perilune_shared.cli.main import main
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.editing.attach import attach
from perilune_shared.editing.diff import differences
from perilune_shared.editing.merge import merge
from perilune_shared.editing.pack import pack, unpack
from perilune_shared.editing.split import Split, split_dataset
from perilune_shared.editing.subset import subset
from perilune_shared.editing.writer import new_dataset
from perilune_shared.errors import UserError
from perilune_shared.storage.store import ObjectStore, open_store
from perilune_shared.validation.validate import validate

TOOLS = {
    "subset": lambda source, out: subset(source, out, where=["split == 'train'"]),
    "merge": lambda source, out: merge([source, source], out),
    "split": lambda source, out: split_dataset(source, out, Split(by="frame", val_share=0.2, test_share=0.2)),
    "pack": lambda source, out: pack(source, out, shard_mb=0.001),
    "unpack": lambda source, out: unpack(source, out),
    "manifest": lambda source, out: subset(source, out, images="none"),
}


@pytest.fixture(params=["memory", "s3"])
def address(request, tmp_path) -> str:
    return f"{request.getfixturevalue('s3_bucket')}/moon" if request.param == "s3" else f"memory://{tmp_path.name}"


@pytest.mark.parametrize("name", TOOLS)
def test_a_result_at_an_address_equals_the_local_one(name, little, address, tmp_path):
    TOOLS[name](open_dataset(little), f"{address}/made")
    TOOLS[name](open_dataset(little), tmp_path / "made")
    made, local = open_store(f"{address}/made"), open_store(tmp_path / "made")
    assert validate(open_dataset(made)) == [] and differences(open_dataset(made), open_dataset(local)) == []
    assert [(item.path, made.read(item.path)) for item in made.list()] == [
        (item.path, local.read(item.path)) for item in local.list()
    ]


def test_a_chain_of_tools_stays_at_the_address(little, address):
    pack(open_dataset(little), f"{address}/packed")
    unpack(open_dataset(f"{address}/packed"), f"{address}/unpacked")
    subset(open_dataset(f"{address}/unpacked"), f"{address}/absent", images="none")
    attach(open_dataset(f"{address}/absent"), f"{address}/unpacked", f"{address}/attached")
    attached = open_dataset(f"{address}/attached")
    assert validate(attached) == [] and len(attached) == 6


def test_a_failed_command_leaves_nothing(little, address):
    with pytest.raises(UserError, match="none left"):
        subset(open_dataset(little), f"{address}/made", where=["time_s < 0"])
    with pytest.raises(RuntimeError), new_dataset(f"{address}/made", open_dataset(little).info) as writer:
        writer.add_scene(open_dataset(little).scene("s000"))
        writer.add_file("notes.txt", b"x")
        raise RuntimeError
    assert list(open_store(address).list()) == []


def test_an_address_in_use_is_refused(little, address):
    source = open_dataset(little)
    with new_dataset(f"{address}/made", source.info) as writer:
        with pytest.raises(UserError, match=rf"{address}/made: --out: got an address that is not empty"):
            subset(source, f"{address}/made")
        for scene_id in source.scene_ids():
            tables = source.scene(scene_id)
            writer.add_scene(tables)
            writer.add_images(
                source, tables["frames"], {n: n for n in tables["frames"]["frame_id"].to_pylist()}, link=False
            )
    assert validate(open_dataset(f"{address}/made")) == []
    with pytest.raises(UserError, match="outside the dataset"):
        subset(open_dataset(f"{address}/made"), f"{address}/made/inside")


def test_of_two_writers_that_find_an_address_empty_one_is_refused(little, s3_bucket, monkeypatch):
    source = open_dataset(little)
    with new_dataset(f"{s3_bucket}/made", source.info) as writer:
        writer.add_scene(source.scene("s000"))
        before = list(open_store(s3_bucket).list())
        monkeypatch.setattr(ObjectStore, "list", lambda store, prefix="": iter(()))
        with pytest.raises(UserError, match="not empty"):
            subset(source, f"{s3_bucket}/made")
        monkeypatch.undo()
        assert list(open_store(s3_bucket).list()) == before
        writer.add_images(
            source,
            source.scene("s000")["frames"],
            {f"s000/t000/{k:06d}": f"s000/t000/{k:06d}" for k in range(3)},
            link=False,
        )


def test_dataset_json_is_complete_only_after_all_other_files(little, s3_bucket, monkeypatch):
    written = []

    def spied(name):
        plain = getattr(ObjectStore, name)

        def call(store, path, content, **options):
            written.append((path, b'"complete": true' in content))
            plain(store, path, content, **options)

        monkeypatch.setattr(ObjectStore, name, call)

    spied("write")
    spied("replace")
    subset(open_dataset(little), f"{s3_bucket}/made")
    assert written[0] == ("dataset.json", False) and written[-1] == ("dataset.json", True)
    assert [path for path, complete in written if complete] == ["dataset.json"]


def test_a_command_writes_to_an_address(little, s3_bucket):
    done = in_process.call(main, "subset", little, "--out", f"{s3_bucket}/made", "--frames", "4")
    assert done.returncode == 0 and f"{s3_bucket}/made: 2 scenes" in done.stdout
    again = in_process.call(main, "subset", little, "--out", f"{s3_bucket}/made")
    assert again.returncode == 2 and f"error: {s3_bucket}/made: --out: " in again.stderr
