"""Devices of Cycles. A machine with a GPU skips the tests of the GPU's types."""

import pytest
from tests.helpers import in_process
from tests.helpers.scenes import config_with

from perilune_render.cli.main import main
from perilune_render.config.dataset import RenderConfig
from perilune_render.dataset.regenerate import _on_this_machine
from perilune_render.engines.blender.devices import bpy, check_device, use_device
from perilune_shared.errors import UserError

TYPES = ("cuda", "optix", "hip", "oneapi", "metal")


def is_found(name):
    try:
        return bool(check_device(name))
    except UserError:
        return False


@pytest.fixture(params=TYPES)
def missing(request):
    if is_found(request.param):
        pytest.skip(f"Cycles finds a device {request.param}")
    return request.param


def test_the_processor_is_the_default():
    stage = bpy.context.scene
    use_device(stage, RenderConfig().cycles_device)
    assert stage.cycles.device == "CPU"


def test_a_missing_device_is_refused_in_one_line(missing, tmp_path):
    command = (
        "dataset",
        "--preset",
        "tiny",
        "--out",
        tmp_path / "data",
        f"--set=dataset.render.cycles_device={missing}",
    )
    refused = in_process.call(main, *command)
    (line,) = refused.stderr.strip().splitlines()
    assert refused.returncode == 2 and not (tmp_path / "data").exists()
    start = f"error: configuration: dataset.render.cycles_device: got {missing}, but Cycles finds only "
    assert line.startswith(start) and "cpu (" in line.removeprefix(start)
    assert line.endswith("expected cpu, or a device of this type with its driver")


def test_frames_of_a_missing_device_are_regenerated_on_the_processor(missing, capsys):
    config = config_with(render=RenderConfig(cycles_device=missing))
    assert _on_this_machine(config, "moon").render == RenderConfig()
    said = capsys.readouterr()
    assert f"moon: its frames were rendered on a device {missing} of Cycles and are rendered on the processor here" in (
        " ".join((said.out + said.err).split())
    )
