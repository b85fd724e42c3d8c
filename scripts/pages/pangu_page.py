"""Generate the table of PANGU's messages from the server's list."""

from perilune_render.server.pangu.messages import FIRST_SETTING, MESSAGES

_HEAD = """# PANGU's messages

This page lists how `perilune-render serve` responds to each message of PANGU's wire protocol 1.20. *answered*: the
message has an effect or returns a value. *read*: the server acknowledges the message without effect. *refused*: the
server returns an error, and the session continues. See also [Serve images](../how-to/serve.md).

"""


def pangu_page() -> str:
    """The page as Markdown."""
    rows = ["| Number | Message | Response | Note |", "|---|---|---|---|"]
    for number, message in MESSAGES.items():
        kind = "setting" if number >= FIRST_SETTING else "request"
        note = message.note or ("sets the viewpoint" if "Viewpoint" in message.name else "")
        rows.append(f"| {number} | {message.name} | {message.effect} | {note or kind} |")
    return _HEAD + "\n".join(rows) + "\n"
