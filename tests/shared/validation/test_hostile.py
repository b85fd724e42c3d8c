"""A dataset is untrusted: its dataset.json, its index, its files and links."""

import json
import os
import shutil
from pathlib import Path

import pyarrow as pa
import pytest
from tests.helpers.hostile import assert_refused, edit, sealed
from tests.sampling import every

from perilune_shared.dataset.index import read_index, write_index
from perilune_shared.dataset.info_file import read_info, write_info
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.dataset.metadata import recipes_of
from perilune_shared.dataset.parts import write_part
from perilune_shared.errors import UserError
from perilune_shared.storage import files
from perilune_shared.storage.store import open_store


def raw(content):
    """Replace the bytes of dataset.json."""
    return lambda root: (root / "dataset.json").write_bytes(content)


def spliced(old, new):
    """Replace a piece of the text of dataset.json."""

    def damage(root):
        path = root / "dataset.json"
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, 1))

    return damage


def of_recipe(change):
    """Change the first recipe and keep its key."""
    return edit(lambda content: change(next(iter(content["recipes"].values()))))


def rekeyed(change):
    """Change the first recipe and its key."""

    def damage(root):
        info = open_dataset(root).info
        plain = info.recipe().model_dump(mode="json")
        change(plain)
        recipe = info.recipe().model_construct(**plain)
        content = json.loads((root / "dataset.json").read_text())
        content["recipes"] = {recipe.key: plain}
        (root / "dataset.json").write_text(json.dumps(content))

    return damage


def many_recipes(content):
    recipe = next(iter(content["recipes"].values()))
    content["recipes"] = {f"{k:016x}": recipe for k in range(40_000)}


INFO = {
    "empty": (raw(b""), "content"),
    "not JSON": (raw(b"\x89PNG\r\n\x1a\n"), "content"),
    "not UTF-8": (raw(b'{"name": "\xff\xfe\x80"}'), "content"),
    "a list": (raw(b"[]"), "content"),
    "a number of a million digits": (raw(b'{"schema_version": ' + b"9" * 1_000_000 + b"}"), "content"),
    "100 MB": (raw(b" " * 100_000_000), "size"),
    "nested 100 000 deep": (raw(b'{"schema_version": "4", "name": ' + b"[" * 100_000), "content"),
    "nested 900 deep": (raw(b'{"schema_version": "4", "name": ' + b"[" * 900 + b"]" * 900 + b"}"), "content"),
    "config nested 900 deep": (spliced('"config": {', '"config": {"a": ' + "[" * 900 + "]" * 900), "content"),
    "a member twice": (spliced('"kind"', '"name": "other", "kind"'), "duplicate"),
    "a member of a recipe twice": (spliced('"preset"', '"seed": 1, "preset"'), "duplicate"),
    "NaN": (spliced('"config": {', '"config": {"a": NaN'), "NaN"),
    "Infinity": (spliced('"config": {', '"config": {"a": -Infinity'), "Infinity"),
    "1e999": (spliced('"config": {', '"config": {"a": 1e999'), "1e999"),
    "half a surrogate": (edit(lambda c: c.update(name="\ud800")), "content"),
    "another version": (edit(lambda c: c.update(schema_version="2")), "schema_version"),
    "a version that is a list": (edit(lambda c: c.update(schema_version=["3"])), "schema_version"),
    "an unknown member": (edit(lambda c: c.update(__class__="os.system")), "__class__"),
    "an unknown member of 1 MB": (edit(lambda c: c.update({"x" * 1_000_000: 1})), "xxx"),
    "a name that is a number": (edit(lambda c: c.update(name=1)), "name"),
    "a name that is HTML": (edit(lambda c: c.update(name="<script>alert(1)</script>")), "name"),
    "a name that is a command": (edit(lambda c: c.update(name="$(touch canary)")), "name"),
    "a name with quotes": (edit(lambda c: c.update(name='a" onload="x')), "name"),
    "a name that steers a terminal": (edit(lambda c: c.update(name="a\x1b]0;x\x07")), "name"),
    "a name of two lines": (edit(lambda c: c.update(name="a\nerror: b")), "name"),
    "a name that ends in a line break": (edit(lambda c: c.update(name="a\n")), "name"),
    "a name from right to left": (edit(lambda c: c.update(name="a\u202egnp.exe")), "name"),
    "a licence that is a formula": (edit(lambda c: c.update(licence='=HYPERLINK("x")')), "licence"),
    "history that is HTML": (edit(lambda c: c.update(history=["merged <img src=x>"])), "history"),
    "history that steers a terminal": (edit(lambda c: c.update(history=["a\x9b2J"])), "history"),
    "history from right to left": (edit(lambda c: c.update(history=["a\u202eb"])), "history"),
    "history of a long line": (edit(lambda c: c.update(history=["a" * 501])), "history"),
    "complete by a word": (edit(lambda c: c.update(complete="true")), "complete"),
    "images elsewhere": (edit(lambda c: c.update(images="https://example.org")), "images"),
    "negative counts": (edit(lambda c: c["counts"].update(frames=-1)), "counts.frames"),
    "counts of 10^18": (edit(lambda c: c["counts"].update(labels=10**18)), "counts.labels"),
    "counts of 10^4000": (edit(lambda c: c["counts"].update(labels=10**4000)), "counts.labels"),
    "a camera of 10^5 x 10^5": (edit(lambda c: c["camera"].update(width_px=100_000, height_px=100_000)), "camera"),
    "a camera of no width": (edit(lambda c: c["camera"].update(width_px=0)), "camera.width_px"),
    "a focal length of 10^300": (edit(lambda c: c["camera"].update(fx_px=1e300)), "camera.fx_px"),
    "a camera that mirrors": (edit(lambda c: c["camera"]["rotation_camera_from_body"].reverse()), "camera"),
    "distortion without end": (edit(lambda c: c["camera"].update(distortion=[1e300] * 5)), "ellipse_cx_px"),
    "a lens model without parameters": (edit(lambda c: c["camera"].update(model="unified")), "camera"),
    "a lens model without end": (
        edit(
            lambda c: c["camera"].update(
                model="kannala_brandt", parameters=dict.fromkeys(("k1", "k2", "k3", "k4"), 1e9)
            )
        ),
        "ellipse_cx_px",
    ),
    "a lens model by a formula": (edit(lambda c: c["camera"].update(model="=HYPERLINK()")), "camera"),
    "no recipe": (edit(lambda c: c.update(recipes={})), "recipes"),
    "a recipe under another key": (of_recipe(lambda r: r.update(seed=8)), "recipes"),
    "40 000 recipes": (edit(many_recipes), "recipes"),
    "a key that climbs": (edit(lambda c: c["recipes"].update({"../x": next(iter(c["recipes"].values()))})), "recipes"),
    "settings with HTML": (rekeyed(lambda r: r["config"].update(dem="<script>x</script>")), "recipes"),
    "settings named by a command": (rekeyed(lambda r: r["config"].update({"`id`": 1})), "recipes"),
    "settings that steer a terminal": (rekeyed(lambda r: r["config"].update(a=[{"b": "\x1b[2J"}])), "recipes"),
    "a version that is HTML": (rekeyed(lambda r: r["versions"].update(numpy="<b>1</b>")), "versions"),
}


@pytest.mark.parametrize("name", every(3, INFO))
def test_hostile_dataset_json_is_refused(name, victim, capsys, monkeypatch):
    damage, column = INFO[name]
    damage(victim)
    assert_refused(victim, "", column, capsys, monkeypatch)


def test_unreadable_settings_are_not_written(victim):
    info = open_dataset(victim).info
    odd = info.recipe().model_copy(update={"config": {"dem": "a\x1b.tif"}})
    before = (victim / "dataset.json").read_bytes()
    with pytest.raises(UserError, match="recipes"):
        write_info(victim, info.model_copy(update={"recipes": recipes_of(odd)}))
    assert (victim / "dataset.json").read_bytes() == before


def reindexed(change):
    """Apply `change` to the path of the index."""

    def damage(root):
        (path,) = (root / "index").glob("*.parquet")
        change(path)

    return damage


def named(path):
    """Add a row to the index, which has valid hashes."""

    def damage(root):
        info = read_info(root)
        rows = read_index(open_store(root), info)
        row = pa.table([[path], [0], ["0" * 64]], schema=rows.schema)
        (old,) = (root / "index").glob("*.parquet")
        old.unlink()
        parts = write_index(open_store(root), pa.concat_tables([rows, row]))
        write_info(root, info.model_copy(update={"index": parts}))

    return damage


def linked(name, target):
    """Replace a file or folder of the dataset by a link to `target`, relative to the parent of the dataset."""

    def damage(root):
        path = root / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
        path.symlink_to(target if target.startswith("/") else root.parent / target)

    return damage


def moved(name):
    """Move a folder out of the dataset and replace it by a link."""

    def damage(root):
        (root / name).rename(root.parent / "elsewhere")
        (root / name).symlink_to(root.parent / "elsewhere")

    return damage


def piped(name):
    def damage(root):
        (root / name).unlink(missing_ok=True)
        os.mkfifo(root / name)

    return damage


def folder(name):
    def damage(root):
        (root / name).unlink(missing_ok=True)
        (root / name).mkdir()

    return damage


def added(name, content=b"x"):
    def damage(root):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(content)

    return damage


def sparse(name):
    def damage(root):
        with (root / name).open("r+b") as stream:
            stream.truncate(2**40)

    return damage


_PNG = "frames/s000/t000/000000.png"
_FRAMES = "manifest/frames/all.parquet"
FILES = {
    "no index": (reindexed(Path.unlink), "index", "file"),
    "an empty index": (reindexed(lambda path: path.write_bytes(b"")), "index", "bytes"),
    "an index of 1 TiB": (reindexed(lambda path: os.truncate(path, 2**40)), "index", "bytes"),
    "an index by a link": (
        reindexed(lambda path: linked(f"index/{path.name}", "canary/secret.txt")(path.parents[1])),
        "index",
        "file",
    ),
    "an index through a pipe": (reindexed(lambda path: piped(f"index/{path.name}")(path.parents[1])), "index", "file"),
    "another index": (added("index/0123456789abcdef.parquet"), "index/0123456789abcdef.parquet", "file"),
    "a climbing path in the index": (named("../canary/secret.txt"), "index", "path"),
    "an absolute path in the index": (named("/etc/passwd"), "index", "path"),
    "a path of 10 kB in the index": (named("z" * 10_000), "index", "path"),
    "a path with NUL in the index": (named("z\0z"), "index", "path"),
    "a path that steers a terminal in the index": (named("z\x1b[2J"), "index", "path"),
    "a path twice in the index": (named(_FRAMES), "index", "path"),
    "a missing file in the index": (named("LICENSE"), "LICENSE", "SHA-256"),
    "a program in the index": (sealed(added("setup.py")), "setup.py", "file"),
    "dataset.json without its hash": (edit(lambda content: content.pop("sha256")), "dataset.json", "SHA-256"),
    "an index in another folder": (
        edit(lambda content: content["index"][0].update(path="../index/0123456789abcdef.parquet")),
        "dataset.json",
        "index.0.path",
    ),
    "dataset.json by a link": (sealed(linked("dataset.json", "canary/secret.txt")), "dataset.json", "link"),
    "dataset.json by a link to itself": (linked("dataset.json", "dataset/dataset.json"), "dataset.json", "link"),
    "dataset.json through a pipe": (sealed(piped("dataset.json")), "dataset.json", "pipe"),
    "dataset.json as a folder": (sealed(folder("dataset.json")), "dataset.json", "folder"),
    "a part by a link": (linked(_FRAMES, "canary/frames.parquet"), _FRAMES, "part"),
    "a part by a link, sealed": (sealed(linked(_FRAMES, "canary/frames.parquet")), _FRAMES, "part"),
    "a part by a link to itself": (sealed(linked(_FRAMES, f"dataset/{_FRAMES}")), _FRAMES, "part"),
    "a part by a link to a device": (sealed(linked(_FRAMES, "/dev/zero")), _FRAMES, "part"),
    "a part by a link to nothing": (sealed(linked(_FRAMES, "nothing")), _FRAMES, "part"),
    "a part through a pipe": (sealed(piped(_FRAMES)), _FRAMES, "file"),
    "a part as a folder": (sealed(folder(_FRAMES)), _FRAMES, "file"),
    "a part of one byte": (sealed(added("manifest/frames/b.parquet")), "manifest/frames/b.parquet", "content"),
    "the manifest by a link": (moved("manifest"), "manifest", "link"),
    "a table by a link": (moved("manifest/labels"), "labels", "link"),
    "shards by a link": (linked("shards", "canary"), "shards", "link"),
    "a part named by a command": (sealed(added("manifest/frames/a$(id).parquet")), "a$(id).parquet", "part"),
    "a part named with a blank": (sealed(added("manifest/frames/a b.parquet")), "a b.parquet", "part"),
    "a part named with a line break": (sealed(added("manifest/frames/a\nb.parquet")), "a b.parquet", "part"),
    "a part of three names": (sealed(added("manifest/frames/a.b.c.parquet")), "a.b.c.parquet", "part"),
    "a part that is not in the index": (added("manifest/frames/z.parquet"), "z.parquet", "file"),
    "a script in the manifest": (added("manifest/setup.py"), "manifest/setup.py", "file"),
    "frames by a link": (moved("frames"), _FRAMES, "png_path"),
    "a frame by a link": (linked(_PNG, "canary/frame.png"), _FRAMES, "png_path"),
    "a frame by a link to itself": (linked(_PNG, f"dataset/{_PNG}"), _FRAMES, "png_path"),
    "a frame by a link to a device": (linked(_PNG, "/dev/zero"), _FRAMES, "png_path"),
    "a frame through a pipe": (piped(_PNG), _PNG, "png_path"),
    "a frame as a folder": (folder(_PNG), _PNG, "png_path"),
    "a frame of 1 TiB": (sparse(_PNG), _PNG, "png_bytes"),
    "a part grown to 1 TiB": (sparse(_FRAMES), _FRAMES, "content"),
}


@pytest.mark.parametrize("name", every(3, FILES))
def test_hostile_files_are_refused(name, victim, capsys, monkeypatch):
    damage, file, column = FILES[name]
    damage(victim)
    assert_refused(victim, file, column, capsys, monkeypatch)


def test_a_folder_name_with_markup(victim, capsys, monkeypatch):
    """The name of the dataset's folder may be hostile too."""
    odd = victim.parent / "[" / "red]"
    odd.parent.mkdir()
    victim.rename(odd)
    (odd / _FRAMES).unlink()
    assert_refused(odd, _FRAMES, "SHA-256", capsys, monkeypatch)


@pytest.mark.parametrize("name", ["../../canary/x", "/tmp/x", "a b", "", "a/b", "a.b.c", "a\n", "-rf", ".x", "a" * 300])
def test_parts_are_written_only_under_plain_names(name, victim):
    rows = open_dataset(victim).table("scenes")
    with pytest.raises(UserError, match="part"):
        write_part(victim, "scenes", name, rows)


@pytest.mark.parametrize("path", ["loop/a.png", "a" * 201, "/".join(["a"] * 300), "frames\\a.png", "frames/\u00e4.png"])
def test_impossible_paths_are_refused(path, victim):
    (victim / "loop").symlink_to(victim / "loop")
    with pytest.raises(UserError, match="path"):
        files.inside(victim, path)
