"""What a page of Markdown shows: its elements, addresses and text."""

import html.parser

from markdown_it import MarkdownIt


class Elements(html.parser.HTMLParser):
    """Names of elements, addresses that they refer to, and all text."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []
        self.addresses: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.names.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("href", "src")]

    def handle_data(self, data: str) -> None:
        self.text += data


def shown(markdown: str) -> Elements:
    """Render a page as GitHub does, with HTML, tables and strikethrough."""
    found = Elements()
    found.feed(MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"]).render(markdown))
    return found
