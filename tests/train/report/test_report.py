"""Content of the report: marks, masks, provenance, what is missing, hostile names, damaged files."""

import base64
import html
import io
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from tests.helpers.drawn_dataset import seal
from tests.helpers.hostile import rewrite
from tests.train.report.conftest import BLOCKS, HEADLINE, HOSTILE, report_command

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.storage.files import sha256_of
from perilune_train.cli import report as command
from perilune_train.records.metrics_file import write_metrics
from perilune_train.report.ground import shaded_ground
from perilune_train.report.page import SUMMARY, gather, json_block, write_report
from perilune_train.report.pictures import drawing, svg_of
from perilune_train.report.summary import summary_of


def data_of(page: Path) -> dict:
    """The viewer's data of a page."""
    return json.loads(re.search(r'<script type="application/json"[^>]*>(.*?)</script>', page.read_text(), re.S)[1])


def image_of(uri: str) -> Image.Image:
    return Image.open(io.BytesIO(base64.b64decode(uri.partition(",")[2])))


def test_the_viewer_has_the_frames_labels_and_detections_of_the_dataset(page, report_data):
    dataset = open_dataset(str(report_data / "detect"))
    frames = data_of(page)["frames"]
    assert [frame["name"] for frame in frames] == [f"s004/t004/{k:06d}" for k in range(4)]
    for frame in frames:
        true = dataset[frame["name"]]
        np.testing.assert_array_equal(np.asarray(image_of(frame["image"])), true.image)
        rows = true.labels
        assert len(frame["labels"]) == len(rows)
        expected = rows[["ellipse_cx_px", "ellipse_cy_px", "ellipse_a_px", "ellipse_b_px"]].to_numpy()
        np.testing.assert_allclose([mark[1:5] for mark in frame["labels"]], expected, atol=0.006)
        degrees = np.degrees(rows["ellipse_theta_rad"].to_numpy())
        np.testing.assert_allclose([mark[5] for mark in frame["labels"]], degrees, atol=0.006)
        # The one false detection of each frame is a box of 40 x 10 px.
        wide = [mark for mark in frame["detections"] if mark[3:5] == [40, 10]]
        assert [mark[1:3] for mark in wide] == [[1, 2]] and wide[0][0] in ("false", "unjudged")
    kinds = {mark[0] for frame in frames for mark in frame["labels"]}
    # Every fourth crater is eroded, so that it is not evaluated; every second label is found.
    assert kinds == {"found", "missed", "ignored"}
    matched = sum(mark[0] == "matched" for frame in frames for mark in frame["detections"])
    assert matched == sum(mark[0] == "found" for frame in frames for mark in frame["labels"]) > 5


def test_masks_are_drawn_from_dark_to_bright(page):
    masks = data_of(page)["masks"]
    assert [mask["block"] for mask in masks] == list(BLOCKS)
    picture = image_of(masks[0]["images"][0])
    assert picture.size == (48, 48) and (masks[0]["low"], masks[0]["high"]) == (0, 2)
    colours = np.asarray(picture.convert("RGB"))
    assert colours[0, 0].tolist() == [0, 34, 78]  # the ends of cividis
    assert colours[0, -1].tolist() == [254, 232, 56]


def test_each_figure_states_its_source(report, page):
    assert all(figure.sources for section in report.sections for figure in section.figures)
    text = page.read_text()
    n_figures = len(re.findall(r"<figcaption>", text))
    assert n_figures > 12
    assert len(re.findall(r'<figcaption>(?:(?!</figcaption>).)*class="source"', text, re.S)) == n_figures
    assert f"dataset {'ab' * 6}" in text and "ab" * 32 in text


def facts_of(text: str) -> dict[str, dict[str, str]]:
    """What the provenance of a page states, by the anchor of each source."""
    lists = re.findall(r'<dl id="(source-[0-9a-f]+)">(.*?)</dl>', text, re.S)
    pair = re.compile(r"<dt>(.*?)</dt><dd>(.*?)</dd>", re.S)
    return {anchor: {name: html.unescape(value) for name, value in pair.findall(own)} for anchor, own in lists}


def test_each_figure_leads_to_command_configuration_seed_commit_versions_and_hashes(page, report_data, report_runs):
    text = page.read_text()
    facts = facts_of(text)
    sourced = re.findall(r"<(figcaption|caption)>(.*?)</\1>", text, re.S)
    anchors = [re.findall(r'class="source"><a href="#(.*?)">', own) for _, own in sourced]
    assert len(anchors) > 15 and all(own and set(own) <= facts.keys() for own in anchors)
    expected = {"command", "SHA-256 of the configuration", "random seed", "commit", "versions", "date", "hardware"}
    assert all(expected <= own.keys() and all(own.values()) for own in facts.values())
    by_source = {own["source"]: own for own in facts.values()}
    metrics = json.loads((report_runs / "detect/demo/metrics.json").read_text())
    found = by_source["detect/demo"]
    for name in ("command", "commit", "versions", "date"):
        assert found[name] == metrics[f"run/{name}"]
    assert found["random seed"] == "0" and found["SHA-256 of dataset"] == "ab" * 32
    assert found["SHA-256 of the configuration"] == sha256_of(report_runs / "detect/demo/config.yaml")
    # The run of explanation in this test has no configuration.
    assert by_source["explain/demo"]["random seed"] == "not recorded"
    assert by_source["explain/demo"]["versions"] == metrics["run/versions"]
    # Both datasets have one name.
    for kind in ("detect", "nav"):
        info = open_dataset(str(report_data / kind)).info
        (recipe,) = info.recipes.values()
        found = by_source[f"dataset {info.name} ({kind})"]
        assert found["versions"] == ", ".join(sorted(f"{name} {version}" for name, version in recipe.versions.items()))
        assert found["random seed"] == str(recipe.seed) and found["command"] == found["commit"] == "not recorded"
        assert found["SHA-256 of dataset.json"] == sha256_of(report_data / kind / "dataset.json")


def test_the_methods_have_their_record_and_an_older_folder_says_that_it_has_none(report_data, report_runs, tmp_path):
    runs = Path(shutil.copytree(report_runs, tmp_path / "runs"))
    folder = runs / "navigate/demo-methods"
    folder.mkdir()
    rows = {"method": ["klt", "fix"], "kind": ["relative", "absolute"], "position_rmse_m": [1.0, 3.0]}
    pd.DataFrame(rows).to_parquet(folder / "navigation.parquet")

    def provenance() -> dict[str, str]:
        (found,) = (one for one in gather("demo", "demo", report_data, runs).provenance if "methods" in one.source)
        return dict(found.facts)

    older = provenance()
    assert older["SHA-256 of navigation.parquet"] == sha256_of(folder / "navigation.parquet")
    assert {older[name] for name in ("command", "commit", "versions", "random seed")} == {"not recorded"}
    write_metrics(folder, {"split": "test", "seed": "fixed in the code"})
    (folder / "inputs.json").write_text(json.dumps({"detector": "cd" * 32}))
    recorded = provenance()
    assert "torch" in recorded["versions"] and recorded["random seed"] == "fixed in the code"
    assert recorded["SHA-256 of detector"] == "cd" * 32
    assert recorded["SHA-256 of navigation.parquet"] == older["SHA-256 of navigation.parquet"]


def test_missing_parts_are_named_and_left_out(report_data, report_runs, page, tmp_path):
    assert "methods demo-methods" in page.read_text()
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "detect").symlink_to(report_data / "detect")
    out = write_report("demo", "other", tmp_path / "data", report_runs, tmp_path / "out")
    text = out.read_text()
    assert "detect run other: no finished run" in text and "dataset nav" in text
    assert "Crater detection" not in text and "Dataset for detection" in text
    assert {mark[0] for frame in data_of(out)["frames"] for mark in frame["labels"]} == {"found", "ignored"}


def test_the_summary_has_the_figures(report):
    text = summary_of(report)
    assert "- demo: AP 0.750, precision 0.750, recall 0.750, F1 0.750" in text
    assert "| stack | 2.000 |" in text
    own = text.partition("- detect/demo")[2].partition("\n- ")[0]
    assert "\n  - versions: perilune\\_train " in own and "\n  - random seed: 0\n" in own
    assert "| gates see craters | 0.3 | - | - | holds | pcc\\_detect.png |" in text.replace("craters  |", "craters |")


def test_the_headline_of_the_explanation_is_first(report, page):
    # After the line that says what the preset `tiny` is for.
    assert report.summary[1] == f"demo: {HEADLINE}"
    (section,) = (one for one in report.sections if one.title == "Explanation")
    assert section.lead[0] == HEADLINE and section.lead[1].startswith("Claims: ")
    lines = summary_of(report).splitlines()
    assert lines[3].replace("\\", "") == f"- demo: {HEADLINE}"
    assert re.search(r"<h1>.*?<li>.*?<li>(.*?)</li>", page.read_text(), re.S)[1] == f"demo: {HEADLINE}"


@pytest.mark.parametrize("headline", [None, "", 3])
def test_a_run_without_a_headline_shows_its_claims(report_data, report_runs, tmp_path, headline):
    runs = Path(shutil.copytree(report_runs, tmp_path / "runs"))
    write_metrics(runs / "explain/demo", {} if headline is None else {"headline": headline})
    report = gather("demo", "demo", report_data, runs)
    (section,) = (one for one in report.sections if one.title == "Explanation")
    assert section.lead == ("Claims: 1; holds: 1.",) and report.summary[1].startswith("demo: AP")


def test_hostile_names_stay_texts(hostile_page):
    text = hostile_page.read_text()
    assert html.escape(HEADLINE + HOSTILE[:9]) in text
    assert "window.hacked" in text
    assert not re.search(r"<script>window|<img src=x", text)
    assert "\u2028" not in re.search(r"<script type=.application/json.*?</script>", text, re.S)[0]
    assert data_of(hostile_page)["frames"][0]["name"].startswith(HOSTILE)
    # In the recipe, the configuration, claims, captions, methods, names and title.
    assert text.count("window.hacked") > 20
    assert "<script" not in (hostile_page.parent / SUMMARY).read_text().replace("\\<", "")


def test_json_cannot_end_its_element():
    content = {"a": "</script><!--", "b": "\u2028\u2029&"}
    text = json_block(content)
    assert not set("<>&\u2028\u2029") & set(text) and json.loads(text) == content


def test_svg_has_no_styles_and_the_colour_of_the_text():
    with drawing() as figure:
        figure.subplots().plot([0, 1], [0, 1], label="<b>$x$", linestyle="--")
        figure.legend()
        made = svg_of(figure, 'a "quote"'), svg_of(figure, "second")
    assert "style=" not in made[0] and "<style" not in made[0] and "<b>" not in made[0]
    assert "currentColor" in made[0] and "stroke-dasharray" in made[0] and "font-size" in made[0]
    ids = [set(re.findall(r'id="([^"]+)"', one)) for one in made]
    assert ids[0] and not ids[0] & ids[1]
    for one, own in zip(made, ids, strict=True):
        assert set(re.findall(r"url\(#([^)]+)\)", one)) | set(re.findall(r'href="#([^"]+)"', one)) <= own


def test_the_side_of_a_bowl_that_faces_the_sun_is_bright():
    crater = pd.DataFrame({"x_m": [0.0], "y_m": [0.0], "diameter_m": [100.0], "depth_m": [10.0]})
    east = np.array([np.cos(np.radians(30)), 0, np.sin(np.radians(30))])
    image = shaded_ground(crater, east, 100.0, 100).astype(int)
    # The Sun is at positive x: the wall at negative x faces it. Slope of the parabola at half the radius: 0.2.
    flat = round(255 * 0.6)
    assert image[2, 2] == pytest.approx(flat, abs=2)
    lit = 255 * 0.6 * (east[2] + 0.2 * east[0]) / np.hypot(1, 0.2) / east[2]
    assert image[50, 37] == pytest.approx(lit, abs=4)
    assert image[50, 62] < flat - 30


def test_the_command(report_data, report_runs, tmp_path):
    given = ["--dataset", report_data, "--runs", report_runs, "--out", tmp_path / "out"]
    done = report_command("--name", "demo", *given)
    assert done.returncode == 0 and (tmp_path / "out/report.html").is_file(), done.stderr
    assert re.search(r"report\.html: \d\.\d MB, ", done.stderr.replace("\n", " ")) and "warning" not in done.stderr
    done = report_command("--name", "../demo", *given)
    assert done.returncode == 2 and "--name" in done.stderr and done.stderr.count("\n") == 1
    nothing = tmp_path / "nothing"
    done = report_command("--kind", "paper", "--dataset", nothing, "--runs", nothing, "--out", tmp_path / "none")
    assert done.returncode == 2 and "no dataset" in done.stderr and not (tmp_path / "none").exists()


def test_a_page_above_15_mb_is_written_with_a_warning(report_data, report_runs, tmp_path, monkeypatch):
    assert command.USUAL_MB == 15
    monkeypatch.setattr(command, "USUAL_MB", 0.05)
    done = report_command("--name", "demo", "--dataset", report_data, "--runs", report_runs, "--out", tmp_path / "out")
    (line,) = (line for line in done.stderr.splitlines() if line.startswith("warning: "))
    size = (tmp_path / "out/report.html").stat().st_size / 1e6
    assert done.returncode == 0 and f"report.html: size: got {size:.1f} MB, expected below 0.05 MB" in line


def test_hostile_names_of_frames_are_refused(report_data, report_runs, tmp_path):
    data = Path(shutil.copytree(report_data, tmp_path / "data"))
    rewrite(data / "detect", "frames", lambda rows: [row.update(frame_id=f"{HOSTILE}/t/000000") for row in rows])
    seal(data / "detect")
    with pytest.raises(UserError, match="frame_id"):
        gather("demo", "demo", data, report_runs)
