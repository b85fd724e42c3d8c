"""Write the figures of a benchmark with the record of its run."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from perilune_shared.run_record import run_record
from perilune_shared.storage.files import write_text

# Made when the benchmark starts: a commit or other work may come while it runs.
run_record()


def write_figures(path: Path, figures: Mapping[str, object]) -> None:
    """Write figures and the record of the run as JSON, and print them."""
    text = json.dumps({**figures, "run": asdict(run_record())}, indent=2)
    write_text(path, text + "\n")
    print(path, text)
