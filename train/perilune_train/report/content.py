"""The content of a report as plain data: sections of figures, tables and labelled frames."""

import hashlib
from dataclasses import dataclass, field

from markupsafe import Markup


@dataclass(frozen=True)
class Provenance:
    """The source of a figure: a run or dataset, with hashes, commit, command and hardware."""

    source: str
    """Folder of the run below the folder of all runs, or name and kind of the dataset."""
    settings_sha256: str = ""
    """SHA-256 of config.yaml, or of the dataset's recipes; empty if there is no such file."""
    inputs: dict[str, str] = field(default_factory=dict)
    """SHA-256 of the inputs by name: datasets (of dataset.json) and checkpoints."""
    commit: str = ""
    """Commit of the code; empty if not recorded."""
    date: str = ""
    """Start date, UTC; empty if not recorded."""
    command: str = ""
    """Command line; empty if not recorded."""
    hardware: str = ""
    """Processor, memory and GPU; empty if not recorded."""
    seed: str = ""
    """Random seed; empty if not recorded."""
    versions: str = ""
    """Versions of packages; empty if not recorded."""
    edits: str = ""
    """Edits of a dataset since rendering; empty if there are none."""
    settings: str = ""
    """Content of config.yaml, or the dataset's recipes."""

    @property
    def anchor(self) -> str:
        """Anchor of this source in the page; datasets with the same name get different anchors."""
        return "source-" + hashlib.sha256(repr((self.source, self.inputs)).encode()).hexdigest()[:12]

    @property
    def facts(self) -> tuple[tuple[str, str], ...]:
        """Names and values of the facts about the source; `not recorded` if the files do not contain a value."""
        known = {
            "command": self.command,
            "SHA-256 of the configuration": self.settings_sha256,
            "random seed": self.seed,
            "commit": self.commit,
            "versions": self.versions,
            "date": self.date,
            "hardware": self.hardware,
        }
        stated = [(name, value or "not recorded") for name, value in known.items()]
        inputs = [(f"SHA-256 of {name}", sha256) for name, sha256 in self.inputs.items()]
        edits = [("edits", self.edits)] if self.edits else []
        return (("source", self.source), *stated, *inputs, *edits)


@dataclass(frozen=True)
class Figure:
    """A picture with its caption."""

    html: Markup
    """An inline SVG or an image as a data URI, from pictures.py."""
    caption: str
    """Caption: the quantities drawn, with units."""
    sources: tuple[Provenance, ...]
    """The runs and datasets that it shows."""
    wide: bool = False
    """Whether it takes the whole width of the page."""
    key: str = ""
    """Anchor in the page; empty for none."""


@dataclass(frozen=True)
class Table:
    """A table of texts and links."""

    caption: str
    """Caption: the meaning of the rows."""
    head: tuple[str, ...]
    """Titles of the columns."""
    rows: tuple[tuple[str, ...], ...]
    """Cells, row by row; Markup for a link."""
    sources: tuple[Provenance, ...]
    """The runs and datasets that it shows."""


@dataclass(frozen=True)
class Mark:
    """A crater or a detection on a frame: an ellipse, or a box with sides along the image axes."""

    kind: str
    """found, missed or ignored (labels); matched, false or unjudged (detections)."""
    shape: tuple[float, float, float, float, float]
    """Ellipse: centre x, y and semi-axes, pixels; direction, degrees. Box: x0, y0, width, height, pixels; score."""


@dataclass(frozen=True)
class FramePicture:
    """A frame with its labels and detections."""

    name: str
    """frame_id."""
    image: str
    """The frame as a data URI."""
    width_px: int
    """Width of the frame; marks are in pixels of the frame."""
    height_px: int
    """Height of the frame."""
    about: str
    """Caption: altitude, Sun elevation and counts."""
    labels: tuple[Mark, ...]
    """Ellipses."""
    detections: tuple[Mark, ...] = ()
    """Boxes."""
    sources: tuple[Provenance, ...] = ()
    """The runs and datasets that it shows."""


@dataclass(frozen=True)
class Section:
    """One part of the report."""

    key: str
    """Anchor in the page."""
    title: str
    """Heading."""
    lead: tuple[str, ...] = ()
    """First lines: the answer, then how it was obtained."""
    tables: tuple[Table, ...] = ()
    """Tables, before the figures."""
    figures: tuple[Figure, ...] = ()
    """Figures, in order."""
    frames: tuple[FramePicture, ...] = ()
    """Labelled frames, after the figures."""


@dataclass(frozen=True)
class MaskStack:
    """Attention masks of one gate over the frames of the viewer."""

    block: str
    """Name of the gate, such as B_11."""
    low: float
    """Attention value that is drawn darkest."""
    high: float
    """Attention value that is drawn brightest."""
    images: tuple[str, ...]
    """One data URI for each frame, empty where there is none."""


@dataclass(frozen=True)
class Viewer:
    """One descent to look through."""

    trajectory: str
    """scene_id/trajectory_id."""
    frames: tuple[FramePicture, ...]
    """Frames from high to low."""
    masks: tuple[MaskStack, ...]
    """Masks of each gate; empty if there is no explain run."""
    sources: tuple[Provenance, ...]
    """The sources of frames, detections and masks."""


@dataclass(frozen=True)
class Report:
    """All parts of a report."""

    title: str
    """Heading of the page."""
    summary: tuple[str, ...]
    """The result, then further results: one sentence each."""
    sections: tuple[Section, ...]
    """Sections in the order of the page."""
    viewer: Viewer | None
    """None without a detection dataset with frames."""
    provenance: tuple[Provenance, ...]
    """All sources, each once."""
    missing: tuple[str, ...]
    """Parts that were left out because their data do not exist."""
