"""The page in a real browser: no error, no request, slider, keys, overlays at the labels, hostile names, axe-core."""

import importlib.resources
import io
import os
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.train.report.needed import needed
from tests.train.report.pdf import images_of

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.geometry.ellipse import Ellipses

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
_path = next((found for name in BROWSERS if (found := shutil.which(name))), None)
# Continuous integration must not skip these tests.
if _path is None and not os.environ.get("CI"):
    pytest.skip("no Chromium: sudo apt-get install chromium", allow_module_level=True)
needed("playwright")

pytestmark = pytest.mark.slow

YELLOW, ORANGE = (240, 228, 66), (230, 159, 0)


@dataclass
class Opened:
    """A page in the browser, and what it did."""

    page: object
    """The page of Playwright."""
    errors: list[str] = field(default_factory=list)
    """Errors and messages of the console."""
    requests: list[str] = field(default_factory=list)
    """Addresses of all requests except for the page itself and data in it."""


@pytest.fixture(scope="module")
def browser() -> Iterator:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        # Chromium has no sandbox for root, which containers run as.
        started = playwright.chromium.launch(executable_path=_path, args=["--no-sandbox"])
        yield started
        started.close()


def load(browser, path: Path, **options) -> Opened:
    context = browser.new_context(**{"viewport": {"width": 1400, "height": 1000}, **options})
    opened = Opened(context.new_page())
    opened.page.on("console", lambda message: opened.errors.append(message.text))
    opened.page.on("pageerror", lambda error: opened.errors.append(str(error)))
    address = path.as_uri()
    opened.page.on(
        "request",
        lambda one: None if one.url == address or one.url.startswith("data:") else opened.requests.append(one.url),
    )
    opened.page.goto(address)
    return opened


@pytest.fixture
def opened(browser, page) -> Iterator[Opened]:
    made = load(browser, page)
    yield made
    assert made.errors == [] and made.requests == []
    made.page.context.close()


def shown(page) -> str:
    return page.get_attribute("#frame", "alt")


def test_slider_buttons_and_keys_change_the_frame(opened):
    page = opened.page
    assert shown(page) == "Frame s004/t004/000000"
    first = page.get_attribute("#frame", "src")
    page.locator("#place").fill("2")
    assert shown(page) == "Frame s004/t004/000002" and page.get_attribute("#frame", "src") != first
    assert page.inner_text("#about").startswith("Frame 3 of 4")
    page.click("#next")
    assert shown(page) == "Frame s004/t004/000003"
    page.keyboard.press("ArrowLeft")
    assert shown(page) == "Frame s004/t004/000002"
    page.focus("#place")
    page.keyboard.press("ArrowLeft")  # the slider's own key, once
    assert shown(page) == "Frame s004/t004/000001"
    for key, group in (("l", ".labels"), ("d", ".detections")):
        assert page.is_visible(f"#stage {group}")
        page.keyboard.press(key)
        assert not page.is_visible(f"#stage {group}")
        page.keyboard.press(key)
        assert page.is_visible(f"#stage {group}")


def test_a_gates_mask_is_switched_on_by_list_and_key(opened):
    page = opened.page
    assert not page.is_visible("#mask")
    before = stage_pixels(page)
    page.select_option("#block", label="B_31")
    assert page.is_visible("#mask") and page.get_attribute("#mask", "alt") == "Attention mask B_31"
    page.locator("#opacity").fill("100")
    page.uncheck("#labels")
    page.uncheck("#detections")
    after = stage_pixels(page)
    # The left half of the mask is 0, dark blue; the right half is 255, yellow.
    height, width = after.shape[:2]
    np.testing.assert_allclose(after[height // 2, width // 8], (0, 34, 78), atol=3)
    np.testing.assert_allclose(after[height // 2, -width // 8], (254, 232, 56), atol=3)
    assert np.abs(before.astype(int) - after).mean() > 20
    assert page.inner_text("#scale").split() == ["B_31:", "0.00", "2.00"]
    page.focus("#next")
    page.keyboard.press("m")
    assert not page.is_visible("#mask")
    page.keyboard.press("m")
    assert page.get_attribute("#mask", "alt") == "Attention mask B_31"


def stage_pixels(page) -> np.ndarray:
    """Pixels (height, width, 3) of the picture with what is drawn over it."""
    page.locator("#stage").evaluate("one => Promise.all([...one.querySelectorAll('img[src]')].map(i => i.decode()))")
    return np.asarray(Image.open(io.BytesIO(page.locator("#stage").screenshot())).convert("RGB")).astype(int)


@pytest.mark.parametrize("width", [1400, 400])
def test_labels_lie_where_the_manifest_says(browser, page, report_data, width):
    opened = load(browser, page, viewport={"width": width, "height": 900})
    opened.page.locator("#place").fill("1")
    opened.page.uncheck("#detections")
    drawn = stage_pixels(opened.page)
    opened.page.uncheck("#labels")
    plain = stage_pixels(opened.page)
    changed = np.abs(drawn - plain).sum(axis=2) > 60
    scale = drawn.shape[1] / 96
    rows = open_dataset(str(report_data / "detect"))["s004/t004/000001"].labels
    names = ("ellipse_cx_px", "ellipse_cy_px", "ellipse_a_px", "ellipse_b_px", "ellipse_theta_rad")
    cx, cy, a, b, theta = (rows[name].to_numpy(np.float64) for name in names)
    contrast = rows["contrast"].to_numpy()
    near = np.zeros(changed.shape, bool)
    found = []
    for k in range(len(rows)):
        t = np.linspace(0, 2 * np.pi, 200)
        x = cx[k] + a[k] * np.cos(t) * np.cos(theta[k]) - b[k] * np.sin(t) * np.sin(theta[k])
        y = cy[k] + a[k] * np.cos(t) * np.sin(theta[k]) + b[k] * np.sin(t) * np.cos(theta[k])
        inside = (x > 1) & (x < 95) & (y > 1) & (y < 95)
        column, row = (scale * x[inside]).astype(int), (scale * y[inside]).astype(int)
        for dx in range(-3, 4):
            for dy in range(-3, 4):
                near[np.clip(row + dy, 0, len(near) - 1), np.clip(column + dx, 0, near.shape[1] - 1)] = True
        if inside.sum() > 50 and contrast[k] > 5:
            found.append(
                np.mean([changed[r - 1 : r + 2, c - 1 : c + 2].any() for r, c in zip(row, column, strict=True)])
            )
    assert len(found) > 3
    # Missed labels are dashed, 5 px of 7.
    assert min(found) > 0.6 and np.mean(found) > 0.8
    # Almost nothing is drawn elsewhere; the rest are ellipses at the very edge.
    inner = np.zeros_like(changed)
    margin = int(2 * scale)
    inner[margin:-margin, margin:-margin] = True
    assert np.mean(near[changed & inner]) > 0.97
    colours = drawn[changed & inner]
    close = [(np.abs(colours - np.array(c)).sum(axis=1) < 40).sum() for c in (YELLOW, ORANGE)]
    assert min(close) > 20
    assert opened.errors == [] and opened.requests == []
    opened.page.context.close()


def test_the_ellipse_of_a_label_has_the_box_of_the_manifest(opened, report_data):
    """The browser's own box of each ellipse of frame 0, compared with the manifest's through shared geometry."""
    rows = open_dataset(str(report_data / "detect"))["s004/t004/000000"].labels
    names = ("ellipse_cx_px", "ellipse_cy_px", "ellipse_a_px", "ellipse_b_px", "ellipse_theta_rad")
    expected = Ellipses(*(rows[name].to_numpy(np.float64) for name in names)).bounding_boxes()
    corners = opened.page.evaluate(
        """() => { const svg = document.querySelector('#stage .marks'), m = svg.getScreenCTM().inverse();
        return [...svg.querySelectorAll('ellipse')].map(e => { const r = e.getBoundingClientRect();
        const s = e.getBBox(); const c = new DOMPoint((r.left + r.right) / 2, (r.top + r.bottom) / 2)
        .matrixTransform(m); return [c.x, c.y, s.width, s.height]; }); }"""
    )
    centres = (expected[:, :2] + expected[:, 2:]) / 2
    np.testing.assert_allclose([one[:2] for one in corners], centres, atol=0.3)
    semi_axes = rows[["ellipse_a_px", "ellipse_b_px"]].to_numpy(np.float64)
    np.testing.assert_allclose([one[2:] for one in corners], 2 * semi_axes, atol=0.02)


def test_hostile_names_do_not_execute(browser, hostile_page):
    opened = load(browser, hostile_page)
    opened.page.locator("#place").fill("1")
    opened.page.select_option("#block", index=1)
    opened.page.wait_for_timeout(200)
    assert opened.page.evaluate("typeof window.hacked") == "undefined"
    assert opened.page.evaluate("document.scripts.length") == 2
    assert "window.hacked" in opened.page.inner_text("#about")
    assert opened.errors == [] and opened.requests == []
    opened.page.context.close()


def test_the_policy_forbids_other_scripts_and_connections(browser, page):
    """What a hostile text could do if it were not escaped: the browser refuses it."""
    opened = load(browser, page)
    opened.page.evaluate(
        """() => { const s = document.createElement('script'); s.textContent = 'window.hacked = 1';
        document.body.append(s); const i = new Image(); i.src = 'http://example.invalid/a.png';
        return fetch('http://example.invalid/').catch(() => 0); }"""
    )
    assert opened.page.evaluate("typeof window.hacked") == "undefined"
    assert sum("Content Security Policy" in text for text in opened.errors) >= 3
    opened.page.context.close()


@pytest.fixture
def asked(browser, answered) -> Iterator[Opened]:
    """The page with answers on detections."""
    made = load(browser, answered.page)
    yield made
    assert made.errors == [] and made.requests == []
    made.page.context.close()


def test_a_click_on_a_detection_opens_its_answers(asked, answered):
    page = asked.page
    answer = max(answered.report.viewer.answers.each, key=lambda one: len(one.pictures))
    marks = answered.report.viewer.frames[answer.frame].detections
    assert not page.is_visible("#answer")
    page.locator("#place").fill(str(answer.frame))
    page.locator("#stage").scroll_into_view_if_needed()
    area = page.locator("#stage .detections rect").nth(answer.detection).bounding_box()
    page.mouse.click(area["x"] + area["width"] / 2, area["y"] + area["height"] / 2)
    # Where boxes overlap, the answers are on the smallest one around the place.
    number = int(re.match(r"Detection (\d+): ", page.inner_text("#answer-title"))[1]) - 1
    mark, wanted = marks[number], marks[answer.detection]
    assert mark.shape[2] * mark.shape[3] <= wanted.shape[2] * wanted.shape[3]
    x, y = (wanted.shape[k] + wanted.shape[k + 2] / 2 for k in (0, 1))
    assert mark.shape[0] <= x <= mark.shape[0] + mark.shape[2] and mark.shape[1] <= y <= mark.shape[1] + mark.shape[3]
    page.locator("#stage .detections rect").nth(answer.detection).press("Enter")
    assert f"Score {wanted.shape[4]:.2f}" in page.inner_text("#answer-title")
    assert page.locator("#answer-pictures figcaption").all_inner_texts() == [one.caption for one in answer.pictures]
    assert page.locator("#answer-why p").all_inner_texts() == list(answer.why)
    assert page.locator("#answer-position p").all_inner_texts() == list(answer.position)
    assert "probability" in page.inner_text("#answer-sure") and "no ellipses" in page.inner_text("#answer-sure")
    assert page.evaluate("document.activeElement.id") == "answer"
    assert page.locator("#stage .chosen").count() == 1
    page.keyboard.press("Escape")
    assert not page.is_visible("#answer") and page.locator("#stage .chosen").count() == 0
    assert page.evaluate("document.activeElement.tagName") == "rect"


def test_detections_without_answers_show_how_sure_they_are(asked, answered):
    viewer = answered.report.viewer
    known = {(one.frame, one.detection) for one in viewer.answers.each}
    frame, number = next(
        (f, k) for f, shown in enumerate(viewer.frames) for k in range(len(shown.detections)) if (f, k) not in known
    )
    page = asked.page
    page.locator("#place").fill(str(frame))
    page.locator("#stage .detections rect").nth(number).press("Enter")
    assert "Not computed for this detection" in page.inner_text("#answer-why")
    assert "Score" in page.inner_text("#answer-sure")
    # Another frame closes the panel.
    page.click("#previous" if frame else "#next")
    assert not page.is_visible("#answer")


def test_the_keyboard_reaches_every_detection_by_one_stop(asked, answered):
    page = asked.page
    counts = [len(frame.detections) for frame in answered.report.viewer.frames]
    count = max(counts)
    assert count > 2
    page.locator("#place").fill(str(counts.index(count)))
    assert page.locator("#stage .detections rect").count() == count
    assert page.locator("#stage [tabindex='0']").count() == 1
    for _ in range(60):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.tagName") == "rect":
            break
    focused = "document.activeElement.getAttribute('aria-label')"
    assert page.evaluate(focused).startswith(f"Detection 1 of {count}: Score ")
    before = shown(page)
    page.keyboard.press("ArrowRight")
    assert page.evaluate(focused).startswith("Detection 2 of") and shown(page) == before
    page.keyboard.press("End")
    assert page.evaluate(focused).startswith(f"Detection {count} of")
    assert page.locator("#stage [tabindex='0']").count() == 1
    page.keyboard.press("Enter")
    assert page.inner_text("#answer-title").startswith(f"Detection {count}: ")
    # Keys of the page still work from the panel.
    page.keyboard.press("ArrowRight")
    assert shown(page) != before


def test_a_button_and_a_key_step_through_the_answers(asked, answered):
    page = asked.page
    each = sorted((one.frame, one.detection) for one in answered.report.viewer.answers.each)
    for number, (frame, detection) in enumerate([*each, each[0]]):
        if number % 2:
            page.keyboard.press("a")
        else:
            page.click("#next-answer")
        assert page.input_value("#place") == str(frame)
        assert page.inner_text("#answer-title").startswith(f"Detection {detection + 1}: ")
        assert page.locator("#stage .answered").count() == sum(one[0] == frame for one in each)


def test_a_page_without_answers_has_no_button_for_them(opened):
    assert opened.page.locator("#next-answer").count() == 0
    opened.page.locator("#stage .detections rect").first.press("Enter")
    assert "no calibration" in opened.page.inner_text("#answer-sure")


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1400, 400])
def test_axe_finds_no_fault_in_the_answers(browser, answered, scheme, width):
    opened = load(browser, answered.page, viewport={"width": width, "height": 900}, color_scheme=scheme)
    opened.page.click("#next-answer")
    assert opened.page.evaluate("document.documentElement.scrollWidth") == width
    opened.page.evaluate((importlib.resources.files("axe_playwright_python") / "axe.min.js").read_text())
    result = opened.page.evaluate("() => axe.run('#viewer')")
    assert len(result["passes"]) > 10
    assert [f"{one['id']}: {one['nodes'][0]['html'][:200]}" for one in result["violations"]] == []
    assert opened.errors == [] and opened.requests == []
    opened.page.context.close()


@pytest.mark.parametrize(("scheme", "width"), [("light", 1400), ("dark", 400)])
def test_axe_finds_no_serious_fault(browser, page, scheme, width):
    opened = load(browser, page, viewport={"width": width, "height": 900}, color_scheme=scheme)
    opened.page.select_option("#block", index=1)
    # The page's policy allows no other script, but the debugger's evaluate is not part of the page.
    opened.page.evaluate((importlib.resources.files("axe_playwright_python") / "axe.min.js").read_text())
    result = opened.page.evaluate("() => axe.run()")
    assert len(result["passes"]) > 15
    faults = [
        f"{one['id']}: {node['html'][:200]}"
        for one in result["violations"]
        if one["impact"] in ("serious", "critical")
        for node in one["nodes"]
    ]
    assert faults == []
    opened.page.context.close()


def test_narrow_pages_do_not_scroll_sideways_and_the_switch_changes_colours(browser, page):
    opened = load(browser, page, viewport={"width": 400, "height": 800}, color_scheme="light")
    assert opened.page.evaluate("document.documentElement.scrollWidth") == 400
    ground = "getComputedStyle(document.body).backgroundColor"
    assert opened.page.evaluate(ground) == "rgb(255, 255, 255)"
    opened.page.click("#theme")
    assert opened.page.evaluate(ground) == "rgb(20, 23, 27)"
    opened.page.emulate_media(media="print")
    assert opened.page.evaluate(ground) == "rgb(255, 255, 255)"
    assert not opened.page.is_visible("#place") and opened.page.is_visible("#frame")
    opened.page.context.close()


@pytest.mark.parametrize("width", [400, 2200])
def test_a_dark_page_has_no_light_band(browser, page, width):
    opened = load(browser, page, viewport={"width": width, "height": 900}, color_scheme="dark")
    pixels = np.asarray(Image.open(io.BytesIO(opened.page.screenshot(full_page=True))).convert("L"))
    # A row of links has bright underlines, which are thinner than the bands of 8 px.
    bands = pixels[: len(pixels) // 8 * 8].reshape(-1, 8 * width)
    assert (bands > 128).mean(axis=1).max() < 0.5
    opened.page.context.close()


def test_printing_to_pdf_shows_the_frame_that_was_chosen(browser, page, report_data):
    opened = load(browser, page)
    opened.page.locator("#place").fill("2")
    whole = opened.page.pdf(print_background=True)
    assert whole.startswith(b"%PDF-") and len(re.findall(rb"/Type\s*/Page\b", whole)) >= 3
    frame = open_dataset(str(report_data / "detect"))["s004/t004/000002"].image
    assert any(np.array_equal(image, frame) for image in images_of(whole))
    # The whole page also has all four frames with labels. Without them only the viewer's is left.
    opened.page.evaluate("document.querySelectorAll('main > section:not(#viewer)').forEach(one => one.remove())")
    (only,) = images_of(opened.page.pdf(print_background=True))
    np.testing.assert_array_equal(only, frame)
    assert opened.errors == [] and opened.requests == []
    opened.page.context.close()
