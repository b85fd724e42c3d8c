"""The content of a report as plain data: sections of figures, tables and labelled frames."""

import hashlib
from dataclasses import dataclass, field

from markupsafe import Markup


@dataclass(frozen=True)
class Provenance:
    """The source of a figure: a run or dataset, with hashes, commit, command and hardware."""

    source: str
    """Path of the run's folder, relative to the folder of all runs; for a dataset, its name and kind."""
    settings_sha256: str = ""
    """SHA-256 of config.yaml, or of the dataset's recipes; empty if there is no such file."""
    inputs: dict[str, str] = field(default_factory=dict)
    """SHA-256 of the inputs by name: checkpoints, and dataset.json of each dataset."""
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
        """Anchor of this source in the page. Different datasets with equal names have different anchors."""
        return "source-" + hashlib.sha256(repr((self.source, self.inputs)).encode()).hexdigest()[:12]

    @property
    def facts(self) -> tuple[tuple[str, str], ...]:
        """Names and values of all facts; the value is `not recorded` if the files do not contain the fact."""
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
    """The runs and datasets that the figure shows."""
    wide: bool = False
    """Whether the figure takes the whole width of the page."""
    key: str = ""
    """Anchor in the page; empty if no link leads to the figure."""


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
    """The runs and datasets that the table shows."""


@dataclass(frozen=True)
class Mark:
    """A label (an ellipse) or a detection (a box along the image axes) on a frame."""

    kind: str
    """Labels: found, missed or ignored. Detections: matched, false or unjudged (not evaluated)."""
    shape: tuple[float, float, float, float, float]
    """Ellipse: centre x, y and semi-axes, pixels; direction, degrees. Box: x0, y0, width, height, pixels; score."""
    ellipse: tuple[float, ...] = ()
    """Ellipse of a detection: semi-axes, pixels; direction, degrees; standard deviations of the centre's x and y and of
    both semi-axes, pixels. Empty if the detector predicts no ellipses."""


@dataclass(frozen=True)
class FramePicture:
    """A frame with its labels and detections."""

    name: str
    """The frame_id."""
    image: str
    """The frame as a data URI."""
    width_px: int
    """Width of the frame, pixels. Marks are in pixels of the frame."""
    height_px: int
    """Height of the frame, pixels."""
    about: str
    """Caption: altitude, Sun elevation and counts."""
    labels: tuple[Mark, ...]
    """Labels, as ellipses."""
    detections: tuple[Mark, ...] = ()
    """Detections, as boxes."""
    sources: tuple[Provenance, ...] = ()
    """The runs and datasets that the picture shows."""


@dataclass(frozen=True)
class Section:
    """One part of the report."""

    key: str
    """Anchor in the page."""
    title: str
    """Heading."""
    lead: tuple[str, ...] = ()
    """First paragraphs: the result, then how it was obtained."""
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
    """Data URI of each frame's mask; empty for a frame without a mask."""


@dataclass(frozen=True)
class AnswerPicture:
    """Ground around a detection, in the frame or in a changed version of it."""

    caption: str
    """The version of the frame, and the score of the detection in it."""
    image: str
    """Data URI of a square of ground."""
    box: tuple[float, float, float, float]
    """Box of the detection: x0, y0, width, height, as shares of the side of the square."""
    overlay: str = ""
    """Data URI of a map over the square; empty without a map."""


@dataclass(frozen=True)
class Answer:
    """Answers on one detection of the viewer, computed in addition to its score and shape."""

    frame: int
    """Index of the frame in the viewer."""
    detection: int
    """Index of the detection in the frame."""
    pictures: tuple[AnswerPicture, ...]
    """The ground with the effect of each patch on the score, and the ground in changed frames."""
    why: tuple[str, ...]
    """Sentences on the ground that decides."""
    position: tuple[str, ...]
    """Sentences on the position that the landing filter computes from the frame."""


@dataclass(frozen=True)
class Answers:
    """Answers on the detections of the viewer."""

    of_score: str
    """Meaning of a score."""
    chosen: str
    """Which detections have an answer, or why none has one."""
    each: tuple[Answer, ...] = ()
    """The answers."""
    sources: tuple[Provenance, ...] = ()
    """The datasets of changed frames."""


@dataclass(frozen=True)
class Viewer:
    """One descent whose frames the reader can step through."""

    trajectory: str
    """Name of the trajectory, scene_id/trajectory_id."""
    frames: tuple[FramePicture, ...]
    """Frames from high to low."""
    masks: tuple[MaskStack, ...]
    """Masks of each gate; empty if there is no explain run."""
    sources: tuple[Provenance, ...]
    """Sources of the frames, detections, masks and answers."""
    answers: Answers | None = None
    """Answers on single detections; None if the frames have no detections."""


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
    """Frames to step through; None if there is no detection dataset with test frames."""
    provenance: tuple[Provenance, ...]
    """All sources, each once."""
    missing: tuple[str, ...]
    """Parts that were left out because their data do not exist."""
