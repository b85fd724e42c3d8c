"""Every number of every setting has a lower and an upper bound."""

import importlib
import pkgutil
import types
import typing
from collections.abc import Iterator

import perilune_render
import perilune_shared
import perilune_train
from perilune_render.config.values import Span, Within
from perilune_shared.config.resolve import Section

_OTHERS = ("bpy", "ray")


def sections() -> list[type[Section]]:
    """All sections of the three packages; imports every file that defines one."""
    for package in (perilune_shared, perilune_render, perilune_train):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            names = found.name.split(".")
            if "config" in names or names[-1].startswith(("settings", "thresholds", "architecture", "native")):
                importlib.import_module(found.name)
    return list(descendants(Section))


def descendants(model: type[Section]) -> Iterator[type[Section]]:
    for one in model.__subclasses__():
        if one.__module__.startswith("perilune_"):
            yield one
            yield from descendants(one)


def unbounded(where: str, annotation: object, limits: tuple = ()) -> Iterator[str]:
    """Names of the numbers in a type that lack a bound; `limits` are those of the value of this type."""
    if typing.get_origin(annotation) is typing.Annotated:
        inner, *own = typing.get_args(annotation)
        yield from unbounded(where, inner, (*limits, *flattened(own)))
    elif annotation is Span:
        if not any(isinstance(limit, Within) for limit in limits):
            yield where
    elif annotation in (int, float):
        if not (has(limits, "ge", "gt") and has(limits, "le", "lt")):
            yield where
    elif typing.get_origin(annotation) in (typing.Union, types.UnionType):
        for part in typing.get_args(annotation):
            yield from unbounded(where, part, limits)
    elif typing.get_origin(annotation) is not typing.Literal:
        for part in typing.get_args(annotation):
            yield from unbounded(f"{where}[]", part)


def flattened(limits: list) -> Iterator[object]:
    for limit in limits:
        yield from limit.metadata if hasattr(limit, "metadata") else [limit]


def has(limits: tuple, *kinds: str) -> bool:
    return any(getattr(limit, kind, None) is not None for limit in limits for kind in kinds)


def test_every_number_of_every_setting_has_two_bounds() -> None:
    models = sections()
    assert len(models) > 30
    found = [
        name
        for model in models
        if model is not Span
        for field, info in model.model_fields.items()
        for name in unbounded(f"{model.__module__}.{model.__name__}.{field}", info.annotation, tuple(info.metadata))
    ]
    assert found == []


def test_numbers_within_lists_mappings_and_optional_values_are_seen() -> None:
    class Sample(Section):
        plain: int
        maybe: float | None = None
        several: tuple[float, ...] = ()
        named: dict[str, int]

    found = [
        name
        for field, info in Sample.model_fields.items()
        for name in unbounded(field, info.annotation, tuple(info.metadata))
    ]
    assert found == ["plain", "maybe", "several[]", "named[]"]
