"""Dataset cards: content, reproduction commands, and escaping of untrusted text."""

import io
import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from huggingface_hub import DatasetCard
from markdown_it import MarkdownIt
from PIL import Image
from rich.progress import Progress
from tests.helpers.drawn_dataset import build_dataset, seal
from typer.testing import CliRunner

from perilune_shared.cli.main import app
from perilune_shared.console.progress import NO_PROGRESS
from perilune_shared.dataset.info_file import write_info
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.dataset.metadata import NOT_STATED, recipes_of
from perilune_shared.dataset.schema import TABLES
from perilune_shared.errors import UserError
from perilune_shared.export.card import write_card
from perilune_shared.export.foreign_text import code_span
from perilune_shared.validation.validate import validate

EVIL = '`</code><script>alert(1)</script> ![x](http://evil) [y](javascript:z) | $(rm) &lt; "\n# owned\n<img src=x>'


def card_files(root, out=None):
    with Progress(disable=True) as progress:
        return [Path(written) for written in write_card(open_dataset(root), out, progress)]


def html_of(page: Path) -> str:
    """Render the page as HTML without removing raw HTML, as some sites do."""
    _, _, body = page.read_text().split("---\n", 2)
    return MarkdownIt("commonmark", {"html": True}).enable("table").render(body)


@pytest.fixture(scope="module")
def card(crowded, tmp_path_factory):
    root = Path(shutil.copytree(crowded, tmp_path_factory.mktemp("card") / "set"))
    page, picture = card_files(root)
    assert (page.name, picture.name) == ("README.md", "card.png")
    return root


def test_huggingface_hub_reads_the_head(card):
    data = DatasetCard.load(card / "README.md").data
    assert (data.license, data.pretty_name, data.size_categories) == ("cc0-1.0", "test", ["n<1K"])
    (frames,) = [config for config in data.configs if config.get("default")]
    assert frames == {
        "config_name": "frames",
        "data_files": [{"split": "mixed", "path": "manifest/frames/*.parquet"}],
        "default": True,
    }


def test_the_head_has_the_format_of_the_hub(card):
    head = yaml.safe_load((card / "README.md").read_text().split("---\n")[1])
    assert head["license"] == "cc0-1.0" and head["task_categories"] == ["object-detection"]
    assert head["pretty_name"] == "test" and head["size_categories"] == ["n<1K"]


def test_the_page_has_counts_quantiles_and_splits(card):
    html, dataset = html_of(card / "README.md"), open_dataset(card)
    counts = dataset.info.counts
    assert f"{counts.frames} frames, {counts.labels:,} labels" in html
    assert html.count("<table>") == 3 and '<img src="card.png"' in html
    radius = dataset.table("labels", ["radius_px"])["radius_px"].to_numpy()
    row = re.search(r"label radius.*?</tr>", html, re.DOTALL)[0]
    cells = [float(value) for value in re.findall(r">([\d.]+)</td>", row)]
    assert np.allclose(cells, np.quantile(radius, [0, 0.05, 0.5, 0.95, 1]), rtol=1e-3)
    assert "Crater detection: 4 trajectories over 4 terrains." in html
    assert "30 to 30" in html and "No terrain is in two splits." in html and "CC0-1.0" in html


def test_the_picture_shows_frames_with_labels(card):
    picture = np.asarray(Image.open(card / "card.png").convert("RGB")).astype(int)
    assert picture.shape[0] > 600 and picture.shape[1] > 800
    green = (picture[..., 1] > 180) & (picture[..., 0] < 120) & (picture[..., 2] < 120)
    orange = (picture[..., 0] > 220) & (abs(picture[..., 1] - 140) < 40) & (picture[..., 2] < 110)
    blue = (picture == [0x44, 0x77, 0xAA]).all(axis=-1)
    assert green.sum() > 500 and orange.sum() > 50 and blue.sum() > 1000
    assert blue[: len(blue) // 2].sum() == 0


@pytest.mark.slow
def test_writing_the_card_again_changes_nothing(card):
    assert validate(open_dataset(card)) == []
    before = {path.name: path.read_bytes() for path in card.iterdir() if path.is_file()}
    card_files(card)
    assert {path.name: path.read_bytes() for path in card.iterdir() if path.is_file()} == before


@pytest.fixture
def of_nobody(little, tmp_path):
    """A dataset as the renderer leaves it: without a licence."""
    root = Path(shutil.copytree(little, tmp_path / "mine"))
    info = open_dataset(root).info
    write_info(open_dataset(root).store, info.model_copy(update={"licence": NOT_STATED}))
    assert validate(open_dataset(root)) == []
    return root


def test_a_licence_is_stated_by_whoever_publishes(of_nobody):
    done = CliRunner().invoke(app, ["card", str(of_nobody)])
    assert done.exit_code == 0, done.output
    page = (of_nobody / "README.md").read_text()
    assert "## Licence\n\nNot stated. To state one:" in page and NOT_STATED not in page
    assert DatasetCard.load(of_nobody / "README.md").data.license == "unknown"
    done = CliRunner().invoke(app, ["card", str(of_nobody), "--licence", "CC-BY-4.0"])
    assert done.exit_code == 0, done.output
    dataset = open_dataset(of_nobody)
    assert dataset.info.licence == "CC-BY-4.0" and validate(dataset) == []
    assert "## Licence\n\n`CC-BY-4.0`\n" in (of_nobody / "README.md").read_text()
    CliRunner().invoke(app, ["card", str(of_nobody)])
    assert open_dataset(of_nobody).info.licence == "CC-BY-4.0", "a card without the option keeps it"


def test_a_card_elsewhere_leaves_the_dataset_as_it_is(of_nobody, tmp_path):
    done = CliRunner().invoke(app, ["card", str(of_nobody), "--licence", "MIT", "--out", str(tmp_path / "card.md")])
    assert done.exit_code == 0, done.output
    assert "`MIT`" in (tmp_path / "card.md").read_text() and open_dataset(of_nobody).info.licence == NOT_STATED


def test_a_licence_that_spdx_does_not_know_is_refused(of_nobody):
    with pytest.raises(UserError, match=r"--licence: got Mine, expected an SPDX licence expression"):
        write_card(open_dataset(of_nobody), None, NO_PROGRESS, "Mine")
    assert not (of_nobody / "README.md").exists()


def test_the_page_warns_of_terrain_in_two_splits(tmp_path):
    splits = {"train": 1, "test": 1}
    root = build_dataset(tmp_path / "nav", "nav", splits=splits, scenes=1, n_frames=2, side_px=32)
    html = html_of(card_files(root)[0])
    assert "1 of 1 terrains are in more than one split" in html and "Split by trajectory" in html


def test_the_page_cites_the_elevation_model(crowded, card, tmp_path):
    root = Path(shutil.copytree(crowded, tmp_path / "set"))
    info = open_dataset(root).info
    (recipe,) = info.recipes.values()
    terrain = {**recipe.config.get("terrain", {}), "elevation": {"citation": "LOLA, PDS"}}
    cited = recipe.model_copy(update={"config": {**recipe.config, "terrain": terrain}})
    write_info(root, info.model_copy(update={"recipes": recipes_of(cited)}))
    part = root / "manifest/scenes/all.parquet"
    rows = [{**row, "recipe": cited.key} for row in pq.read_table(part).to_pylist()]
    pq.write_table(pa.Table.from_pylist(rows, schema=TABLES["scenes"]), part)
    seal(root)
    page = html_of(card_files(root)[0])
    assert "<td>citation of the terrain</td>" in page and "<code>LOLA, PDS</code>" in page
    assert "citation" not in html_of(card / "README.md")


def test_text_from_a_dataset_is_escaped(crowded, card, tmp_path):
    root = Path(shutil.copytree(crowded, tmp_path / "set"))
    part = root / "manifest/scenes/all.parquet"
    rows = pq.read_table(part).to_pylist()
    rows = [{**row, "photometry": EVIL, "dem_source": EVIL[::-1]} for row in rows]
    pq.write_table(pa.Table.from_pylist(rows, schema=TABLES["scenes"]), part)
    dataset = open_dataset(root)
    info = dataset.info.changed("merged " + EVIL).changed("[y](javascript:z) ![x](http://evil) | **b**")
    write_info(root, info)
    seal(root)
    clean, hostile = html_of(card / "README.md"), html_of(card_files(root)[0])
    tags = [re.findall(r"<(\w+)", html) for html in (clean, hostile)]
    history = ["ul", "li", "code", "li", "code"]
    # Scenes with one dem_source are one terrain, here in three splits; the warning about it is bold.
    assert sorted([*tags[0], *history, "strong"]) == sorted([*tags[1], "p"])
    assert "owned" in hostile and "<script" not in hostile and "href" not in hostile


@pytest.mark.parametrize("text", [EVIL, "", "`", " a ", "é\x1b[31m", "\u202eabc"])
def test_code_is_a_code_span(text):
    html = MarkdownIt().render(code_span(text))
    assert re.fullmatch(r"<p><code>[\w ._+,:()/%=?-]+</code></p>\n", html)


def test_the_commands_reproduce_the_configuration(card, tmp_path):
    """The first command of the card, run in a shell, writes the configuration that the second reads."""
    page = (card / "README.md").read_text()
    unpack, make = re.search(r"```sh\n(.*?)\n```", page, re.DOTALL)[1].splitlines()
    shutil.copy(card / "dataset.json", tmp_path)
    subprocess.run(unpack.replace("python", shlex.quote(sys.executable), 1), shell=True, check=True, cwd=tmp_path)
    recipe = open_dataset(card).info.recipe()
    assert yaml.safe_load((tmp_path / "recipe.yaml").read_text()) == {"dataset": recipe.config}
    assert shlex.split(make)[2:] == [
        "--preset",
        "tiny",
        "--kind",
        "detect",
        "--config",
        "recipe.yaml",
        "--out",
        "again",
    ]


@pytest.mark.slow
def test_packed_and_absent_frames(crowded_packed, crowded, card, tmp_path):
    from_packed = card_files(crowded_packed, tmp_path / "packed.md")[1].read_bytes()
    assert np.array_equal(
        *(np.asarray(Image.open(io.BytesIO(b))) for b in (from_packed, (card / "card.png").read_bytes()))
    )
    dataset = open_dataset(crowded)
    dataset.info = dataset.info.model_copy(update={"images": "absent"})
    with Progress(disable=True) as progress:
        page, picture = map(Path, write_card(dataset, tmp_path / "absent.md", progress))
    assert Image.open(picture).height < 500 and "not included (only the manifest)" in page.read_text()


def test_other_files_are_not_overwritten(crowded, tmp_path):
    root = Path(shutil.copytree(crowded, tmp_path / "set"))
    (root / "README.md").write_text("mine")
    with pytest.raises(UserError, match="not a card"):
        card_files(root)
    (root / "README.md").unlink()
    info = json.loads((root / "dataset.json").read_text())
    (root / "dataset.json").write_text(json.dumps(info))
    with pytest.raises(UserError, match="different SHA-256"):
        card_files(root)
    assert not (root / "README.md").exists() and not (root / "card.png").exists()


def test_a_card_of_an_older_version_is_overwritten(card, tmp_path):
    page = tmp_path / "about.md"
    page.write_text("<!-- written by `perilune-manifest card`, in other words -->\n")
    card_files(card, page)
    assert "## Contents" in page.read_text()


def test_a_frame_of_another_size_is_refused(crowded, tmp_path):
    root = Path(shutil.copytree(crowded, tmp_path / "set"))
    for path in root.rglob("*.png"):
        Image.new("L", (4000, 4000)).save(path)
    with pytest.raises(UserError, match="4000 x 4000 px"):
        card_files(root)


def test_frames_of_16_bits_and_no_labels(crowded, card, tmp_path):
    """The picture shows the upper eight bits; a dataset without labels has a card too."""
    root = Path(shutil.copytree(crowded, tmp_path / "set"))
    for path in root.rglob("*.png"):
        grey = np.asarray(Image.open(path)).astype(np.uint16)
        Image.fromarray(grey * 257).save(path)
    pages = [card_files(root, tmp_path / "deep.md")]
    part = root / "manifest/labels/all.parquet"
    pq.write_table(TABLES["labels"].empty_table(), part)
    pages.append(card_files(root, tmp_path / "bare.md"))
    plain, deep, bare = (np.asarray(Image.open(p)) for p in (card / "card.png", *(picture for _, picture in pages)))
    assert np.array_equal(plain, deep)
    assert bare.shape == plain.shape and not np.array_equal(bare, plain)
    assert "label radius" in pages[0][0].read_text() and "label radius" not in pages[1][0].read_text()


def test_command_line(crowded, tmp_path):
    done = CliRunner().invoke(app, ["card", str(crowded), "--out", str(tmp_path / "about.md")])
    assert done.exit_code == 0 and (tmp_path / "about.png").is_file()
    assert "](about.png)" in (tmp_path / "about.md").read_text()
    without = "import sys; sys.modules['matplotlib'] = None; from perilune_shared.cli.main import main; main()"
    command = [sys.executable, "-c", without, "card", str(crowded), "--out", str(tmp_path / "b.md")]
    bare = subprocess.run(command, capture_output=True, text=True)
    assert bare.returncode == 2 and "perilune-shared[pictures]" in bare.stderr
    assert not (tmp_path / "b.md").exists()


def test_singular_for_one_terrain(tmp_path):
    root = build_dataset(tmp_path / "d", "detect", splits={"train": 1}, n_frames=1, side_px=32, craters=40)
    page = card_files(root)[0].read_text()
    assert "Crater detection: one trajectory over one terrain." in page and "many" not in page
