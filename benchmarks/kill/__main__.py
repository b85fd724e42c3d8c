"""Disturb renderings at random moments, resume them, and compare the finished datasets byte by byte.

    python -m benchmarks.kill --n 20                       # all kinds
    python -m benchmarks.kill --kind parent --kind node    # some
    python -m benchmarks.kill --minutes 4                  # start no trial after four minutes; run again to continue

Renders 16 frames (`rendering.py`) over scenes from the cache, once undisturbed, then in each trial. Each trial of
`trials.py` and `cases.py` adds a line to runs/bench/kill.log; trials of the current commit that are in it are not
repeated. Writes runs/bench/kill.json: by kind the number of trials, of those whose dataset is identical to the
undisturbed one, of the moments at which a running command was disturbed and the phases reached by then, the largest
number of attempts, the longest time to the end after Ctrl-C, and whether each error was one line.
"""

import argparse
import contextlib
import json
import random
import shutil
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from tests.helpers.s3_server import new_bucket, s3_variables

from benchmarks.figures import write_figures
from benchmarks.kill import cases, trials
from benchmarks.kill.rendering import Record, Undisturbed
from benchmarks.ray_cluster import LocalCluster
from perilune_shared.run_record import run_record

LOG = Path("runs/bench/kill.log")
Trial = Callable[[str, Undisturbed, random.Random], Record]
LOCAL: dict[str, Trial] = {
    "parent": trials.killed_parent,
    "worker": trials.killed_worker,
    "shard": trials.killed_shard,
    "ctrl-c": partial(trials.interrupted, options=("--workers", "0")),
    "ctrl-c, 1 worker": partial(trials.interrupted, options=("--workers", "1")),
    "ctrl-c, 2 workers": partial(trials.interrupted, options=("--workers", "2")),
    "ctrl-c, Ray": partial(trials.interrupted, options=("--executor", "ray", "--workers", "1")),
    "full disk": cases.full_disk,
    "other processor": cases.other_processor,
    "other code": cases.other_code,
}
"""Trials in a local folder."""
STORED: dict[str, Trial] = {
    "parent, S3": trials.killed_parent,
    "faulty store": cases.faulty_store,
    "vanished store": cases.vanished_store,
}
"""Trials on an S3 server."""
KINDS = (*LOCAL, "node", *STORED)


def main() -> None:
    """Run the trials that are missing, and write the figures."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.kill")
    parser.add_argument("--n", type=int, default=20, help="number of trials of each kind")
    parser.add_argument("--kind", action="append", choices=KINDS, help="kind of trials; may be repeated")
    parser.add_argument("--seed", type=int, default=1, help="random seed of the moments")
    parser.add_argument("--minutes", type=float, default=1e6, help="time after which no trial starts")
    options = parser.parse_args()
    # A shell that starts this in the background lets it, and all that it starts, ignore Ctrl-C.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    end_s = time.monotonic() + 60 * options.minutes
    done = [record for record in _logged() if record["commit"] == run_record().commit]
    wanted = [(kind, k) for k in range(options.n) for kind in options.kind or KINDS]
    missing = [each for each in wanted if each not in {(record["kind"], record["trial"]) for record in done}]
    with tempfile.TemporaryDirectory(prefix="perilune-kill-") as folder, contextlib.ExitStack() as stack:
        whole = Undisturbed.of(f"{folder}/whole", "--workers", "2") if missing else None
        bench = _Bench(Path(folder), stack)
        for number, (kind, k) in enumerate(missing):
            if time.monotonic() > end_s or whole is None:
                break
            draw = random.Random(f"{options.seed} {kind} {k}")
            record = {"kind": kind, "trial": k, **bench.trial(kind, f"trial-{number}", whole, draw)}
            record["commit"] = run_record().commit
            done.append(record)
            line = json.dumps(record)
            print(line, flush=True)
            LOG.parent.mkdir(parents=True, exist_ok=True)
            with LOG.open("a", encoding="utf-8") as log:
                log.write(f"{line}\n")
    write_figures(Path("runs/bench/kill.json"), figures(done))


class _Bench:
    """What trials need besides a folder: a Ray cluster and an S3 server, started when they are first used."""

    def __init__(self, folder: Path, stack: contextlib.ExitStack):
        self._folder, self._stack = folder, stack
        self._cluster: LocalCluster | None = None
        self._bucket = ""

    def trial(self, kind: str, name: str, whole: Undisturbed, draw: random.Random) -> Record:
        """Run one trial."""
        if kind in STORED:
            if not self._bucket:
                self._stack.enter_context(s3_variables())
                self._bucket = new_bucket()
            return STORED[kind](f"{self._bucket}/{name}", whole, draw)
        out = self._folder / name
        try:
            if kind != "node":
                return LOCAL[kind](str(out), whole, draw)
            self._cluster = self._cluster or self._stack.enter_context(LocalCluster(2))
            return trials.killed_node(str(out), whole, draw, self._cluster)
        finally:
            shutil.rmtree(out, ignore_errors=True)


def figures(done: list[dict[str, Any]]) -> dict[str, object]:
    """The figures of all trials."""
    by_kind: dict[str, object] = {}
    for kind in KINDS:
        own = [record for record in done if record["kind"] == kind]
        if own:
            moments = [moment for record in own for moment in record["moments"] if moment["disturbed"]]
            by_kind[kind] = {
                "trials": len(own),
                "identical": sum(record["identical"] for record in own),
                "moments": len(moments),
                "phases": dict(Counter(moment["phase"] for moment in moments)),
                "most_attempts": max(record["attempts"] for record in own),
                "longest_s": max((moment["seconds"] for moment in moments if "seconds" in moment), default=None),
                "in_one_line": all(moment.get("one_line", True) for moment in moments),
            }
    identical = sum(record["identical"] for record in done)
    moments = [moment for record in done for moment in record["moments"] if moment["disturbed"]]
    ctrl_c = [moment["seconds"] for moment in moments if "seconds" in moment]
    return {
        "moments": len(moments),
        "trials": len(done),
        "identical": identical,
        "not_identical": len(done) - identical,
        "longest_ctrl_c_s": max(ctrl_c, default=None),
        "kinds": by_kind,
    }


def _logged() -> list[dict[str, Any]]:
    return [json.loads(line) for line in LOG.read_text(encoding="utf-8").splitlines()] if LOG.exists() else []


if __name__ == "__main__":
    main()
