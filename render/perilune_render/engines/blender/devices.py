"""Devices on which Cycles renders: the processor, or one GPU for each process."""

import bpy

from perilune_shared.errors import UserError
from perilune_shared.threads import worker_number

_TYPES = ("CUDA", "OPTIX", "HIP", "ONEAPI", "METAL")


def use_device(stage: bpy.types.Scene, name: str) -> None:
    """Configure a stage to render on a device of `dataset.render.cycles_device`.

    If there are several devices of this type, each worker process takes the device with its number; if there are more
    workers than devices, they share devices. Raises UserError without such a device.
    """
    if name == "cpu":
        stage.cycles.device = "CPU"
        return
    found = check_device(name)
    chosen = found[worker_number() % len(found)]
    preferences = _preferences()
    preferences.compute_device_type = name.upper()
    for each in preferences.devices:
        each.use = each.type == name.upper() and each.id == chosen
    stage.cycles.device = "GPU"


def check_device(name: str) -> list[str]:
    """Identifiers of the devices of a type, such as `optix`, in Cycles's order.

    Raises UserError if there is none, with the devices that Cycles finds.
    """
    # Cycles's tuples begin with name, type and identifier of a device; each list also has the processor.
    listed = {each for kind in _TYPES for each in map(_first_three, _preferences().get_device_list(kind))}
    found = [
        identifier
        for _, kind, identifier in map(_first_three, _preferences().get_device_list(name.upper()))
        if kind == name.upper()
    ]
    if not found:
        names = ", ".join(f"{kind.lower()} ({title})" for title, kind, _ in sorted(listed)) or "no device"
        expected = "cpu, or a device of this type with its driver"
        raise UserError(
            "configuration", "dataset.render.cycles_device", f"{name}, but Cycles finds only {names}", expected
        )
    return found


def _first_three(device: tuple) -> tuple[str, str, str]:
    return device[0], device[1], device[2]


def _preferences() -> bpy.types.AddonPreferences:
    return bpy.context.preferences.addons["cycles"].preferences
