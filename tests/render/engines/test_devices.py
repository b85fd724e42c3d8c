"""Settings of the device of Cycles, and the numbers by which worker processes choose their GPU."""

import os
import time
from pathlib import Path

import pytest
from tests.helpers.scenes import config_with

from perilune_render.config.dataset import RenderConfig
from perilune_render.jobs.worker import start_worker
from perilune_render.provenance.recipe import recorded_settings
from perilune_shared.errors import UserError
from perilune_shared.threads import WORKER_NUMBER, worker_number


def test_a_recipe_states_a_device_other_than_the_processor():
    default, other = (recorded_settings(config_with(render=render), "detect")["render"] for render in (
        RenderConfig(), RenderConfig(cycles_device="optix")
    ))  # fmt: skip
    assert "cycles_device" not in default and other == default | {"cycles_device": "optix"}


def test_the_other_engine_has_no_device_of_cycles():
    with pytest.raises(ValueError, match="cycles_device cpu, or engine cycles"):
        RenderConfig(engine="heightfield", cycles_device="cuda")


def test_a_worker_knows_its_number(tmp_path, monkeypatch):
    worker = start_worker(str(tmp_path), "heightfield", 3)
    try:
        # The file is empty while the new process replaces its parent's program.
        while not (environment := Path(f"/proc/{worker.process.pid}/environ").read_bytes().strip(b"\0")):
            time.sleep(0.01)
    finally:
        worker.end(at_once=True)
    assert worker.number == 3 and f"{WORKER_NUMBER}=3".encode() in environment.split(b"\0")
    monkeypatch.setenv(WORKER_NUMBER, "3")
    assert worker_number() == 3
    monkeypatch.setenv(WORKER_NUMBER, "-1")
    with pytest.raises(UserError, match="environment: PERILUNE_WORKER: got -1, expected the number of a worker"):
        worker_number()
    monkeypatch.delenv(WORKER_NUMBER)
    assert worker_number() == 0 and WORKER_NUMBER not in os.environ
