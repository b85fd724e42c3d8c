"""Text of other people in Markdown, CSV and on the terminal."""

import pandas as pd
import pytest
from tests.helpers.pages import shown

from perilune_shared.console import terminal
from perilune_shared.export.foreign_text import code_span, for_csv, for_markdown, write_csv

HOSTILE = [
    "<script>alert(1)</script>",
    "![x](http://evil.example/pixel.png)",
    "[click](javascript:alert(1))",
    "`code` **bold** _it_ ~~no~~ # heading",
    "a\n# heading\n\n<img src=x onerror=alert(1)>",
    "\x1b[31mred\x1b]0;title\x07\x9b2J",
    "\u202eevil\u2066",
    "$\\frac$ & &lt;b&gt; @someone",
    "=HYPERLINK(1)|x",
    "\udcff\ud800",
    "http://evil.example www.evil.example <http://evil.example>",
    "\\",
    "",
]


@pytest.mark.parametrize("text", HOSTILE)
def test_markdown_shows_text_and_nothing_else(text: str) -> None:
    for page in (f"before {for_markdown(text)} after", f"before {code_span(text)} after"):
        found = shown(page)
        assert set(found.names) <= {"p", "code"}, found.names
        assert all(c.isprintable() or c == "\n" for c in found.text)
        assert found.text.startswith("before") and "after" in found.text


def test_markdown_keeps_what_a_name_says() -> None:
    for name in ("paper_v2 (0.5, Größe)", "a*b_c[d]<e>$5", "x & y"):
        assert shown(for_markdown(name)).text.strip() == name
    assert for_markdown("scene 0.5, 3 px") == "scene 0.5, 3 px"
    assert code_span("small-none") == "`small-none`"


@pytest.mark.parametrize("text", ["=1+1", "+1", "-1", "@SUM(A1)", " =1", "＝1", "'=1", '"=1', "\t=1", "|cmd", "%0"])
def test_a_cell_is_no_formula(text: str) -> None:
    assert for_csv(text).startswith("'")


def test_csv_keeps_numbers_and_plain_names(tmp_path) -> None:
    table = pd.DataFrame({"image": ["a.png", "=x.png", None], "x_px": [-1.5, 2.0, 3.0], "@n": [1, 2, -3]})
    write_csv(table, tmp_path / "a.csv")
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert lines == [
        "image,x_px,'@n",
        "a.png,-1.5,1",
        "'=x.png,2.0,2",
        ",3.0,-3",
    ]
    assert list(table.columns) == ["image", "x_px", "@n"]


def test_a_terminal_gets_no_control_character(capsys: pytest.CaptureFixture) -> None:
    for text in HOSTILE:
        terminal.say(text)
        terminal.say_page(text)
        terminal.answer(text)
        terminal.answer_page(text)
        terminal.answer_table(["a", text], [[1, text]], title=text, caption=text)
    with terminal.progress_bar() as progress:
        task = progress.add_task("[red]x[/]\x1b[2J", total=1, unit="frames")
        progress.update(task, note="\x1b]0;a\x07")
        progress.advance(task)
    printed = "".join(capsys.readouterr())
    assert all(sign.isprintable() or sign == "\n" for sign in printed)
    assert "[red]x[/]" in printed
