"""Limits of each kind of table that is not part of a dataset. `docs/reference/limits.md` lists them."""

from dataclasses import dataclass

MAX_LINE_BYTES = 65_536
"""Maximum length of a line of text, or of a row whose quoted values contain line breaks."""
MAX_COLUMNS = 1_000
"""Maximum number of columns of a text table."""
MAX_VALUE_CHARACTERS = 1_000
"""Maximum length of a value in a column that is read as text."""
MAX_TEXT_CHARACTERS = 100_000_000
"""Maximum total length of the distinct values of one column that is read as text."""
SPARE_ROWS, BYTES_PER_ROW = 200_000, 4
"""A Parquet file of n bytes has at most SPARE_ROWS + n / BYTES_PER_ROW rows. Measurements need more bytes per row."""


@dataclass(frozen=True, slots=True)
class TableLimits:
    """Limits of one kind of table."""

    kind: str
    """Name of the table's content in messages."""
    rows: int
    """Maximum number of rows."""
    file_bytes: int
    """Maximum size of the file, bytes."""


CATALOGUE = TableLimits("crater catalogue", 5_000_000, 2 * 10**9)
POSES = TableLimits("poses", 1_000_000, 500_000_000)
INERTIAL = TableLimits("inertial measurements", 20_000_000, 4 * 10**9)
RANGES = TableLimits("ranges", 20_000_000, 4 * 10**9)
ATTITUDES = TableLimits("attitudes", 20_000_000, 4 * 10**9)
BEAMS = TableLimits("beams of a Doppler lidar", 20_000_000, 4 * 10**9)
FRAMES = TableLimits("frames", 1_000_000, 500_000_000)
DETECTIONS = TableLimits("detections", 20_000_000, 4 * 10**9)
DETECTABILITIES = TableLimits("detectabilities", 20_000_000, 4 * 10**9)
BOXES = TableLimits("boxes", 1_000_000, 500_000_000)
RUN_TABLE = TableLimits("table of a run", 20_000_000, 4 * 10**9)
KINDS = (CATALOGUE, POSES, INERTIAL, RANGES, ATTITUDES, BEAMS, FRAMES, DETECTIONS, DETECTABILITIES, BOXES, RUN_TABLE)
