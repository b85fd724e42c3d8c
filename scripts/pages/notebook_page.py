"""Convert a Jupyter notebook, with its saved outputs, to Markdown."""

import base64
import re
from pathlib import Path

import nbformat


def notebook_page(path: Path) -> tuple[str, dict[str, bytes]]:
    """Return a notebook's Markdown, and its pictures (PNG bytes) by file name."""
    pieces: list[str] = []
    pictures: dict[str, bytes] = {}
    for cell in nbformat.read(path, as_version=4).cells:
        if cell.cell_type == "markdown":
            pieces.append(cell.source)
            continue
        pieces.append(f"```python\n{cell.source}\n```")
        for output in cell.outputs:
            if output.get("name") == "stderr":  # progress
                continue
            data = output.get("data", {})
            if "image/png" in data:
                name = f"{path.stem}-{len(pictures) + 1}.png"
                pictures[name] = base64.b64decode(data["image/png"])
                pieces.append(f"![Output of the cell above]({name})")
            elif "text/html" in data:
                pieces.append(_plain_table(data["text/html"]))
            else:
                pieces.append(f"```text\n{output.get('text') or data['text/plain']}\n```")
    return "\n\n".join(pieces) + "\n", pictures


def _plain_table(html: str) -> str:
    """Remove the style from an HTML table, so that it looks like the other tables of the site."""
    return re.sub(r"<style.*?</style>|(?<=<table)[^>]*", "", html, flags=re.DOTALL)
