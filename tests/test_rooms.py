"""The order of the rooms: a file imports from its own room and from rooms before it, never from one after it."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ROOMS = {
    "shared/perilune_shared": (
        "errors cgroups photometry threads config console run_record content storage pictures geometry client dataset "
        "labels validation editing export cli"
    ),
    "shared/perilune_shared/console": "interrupts terminal progress usage command_line",
    "shared/perilune_shared/config": "yaml_text errors resolve page",
    "render/perilune_render": (
        "config streams provenance terrain flight poses imaging labels engines outputs dataset detectability preview "
        "server scenes jobs cli"
    ),
    "perilune/perilune": "parts datasets",
    "render/perilune_render/config": "values cameras terrain derived scene outputs dataset",
    "render/perilune_render/engines": "frame_source blender heightfield open_engine",
    "render/perilune_render/cli": (
        "options sun dataset frames spice serve status survey counterfactual detectability main"
    ),
    "render/perilune_render/terrain": (
        "envelope grid interpolation levels noise relief size_frequency craters albedo boulders elevation base scene "
        "unstamped level_ground cache export"
    ),
    "render/perilune_render/jobs": (
        "job records work_list report scene_renderer worker local in_process ray_actors run status estimate"
    ),
    "train/perilune_train": (
        "config compiled records data models training shipped detect motion landing explain report cli"
    ),
    "train/perilune_train/cli": "options detect navigate explain report main",
    "train/perilune_train/detect": (
        "config ellipses calibration finished_run novelty data evaluate inference train calibrate evaluate_runs "
        "benchmark images deploy"
    ),
    "train/perilune_train/motion": (
        "config geometry data network pose classical metrics covariance train evaluate_runs benchmark deploy"
    ),
    "train/perilune_train/landing": "craters filter fly map methods monte_carlo trace",
}
"""Rooms (folders) and files of each folder, in order: each may import those before it."""


def imported_modules(path: Path) -> set[str]:
    """Every module that a file imports anywhere, `from a import b` as a.b."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found


@pytest.mark.parametrize("folder", ROOMS)
def test_imports_flow_one_way(folder):
    root = ROOT / folder
    order = ROOMS[folder].split()
    package = ".".join(root.relative_to(ROOT).parts[1:]) + "."
    here = {path.stem for path in root.iterdir() if path.suffix == ".py" or (path / "__init__.py").is_file()}
    assert here - {"__init__"} == set(order)
    wrong = []
    for path in root.rglob("*.py"):
        room = path.relative_to(root).with_suffix("").parts[0]
        for name in imported_modules(path):
            target = name.removeprefix(package).split(".")[0]
            known = name.startswith(package) and room in order and target in order
            if known and order.index(target) > order.index(room):
                wrong.append(f"{path.relative_to(ROOT)} imports {name}")
    assert not wrong


def test_every_test_named_in_a_page_or_a_docstring_exists():
    files = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    files += [
        path
        for house in ("shared", "render", "train", "perilune", "benchmarks")
        for path in (ROOT / house).rglob("*.py")
    ]
    named = {name for path in files for name in re.findall(r"tests/[\w/*]+\.py", path.read_text(encoding="utf-8"))}
    assert len(named) > 5
    assert [name for name in sorted(named) if not list(ROOT.glob(name))] == []


BLOCKED = """
import importlib, pkgutil, sys
for name in {blocked!r}:
    sys.modules[name] = None
for module in {modules!r}:
    importlib.import_module(module)
    for found in pkgutil.iter_modules(getattr(sys.modules[module], "__path__", ())):
        importlib.import_module(f"{{module}}.{{found.name}}")
"""


SHARED_ROOMS = [
    f"perilune_shared.{room}"
    for room in ["storage", "geometry", "dataset", "labels", "validation", "editing", "export"]
]


@pytest.mark.parametrize(
    ("blocked", "modules"),
    [
        (["torch", "lightning", "bpy"], ["perilune_train.detect.evaluate", "perilune_train.records"]),
        (["torch", "lightning", "bpy", "typer", "rich"], SHARED_ROOMS),
        (
            ["lightning", "bpy"],
            ["perilune_train.detect.images", "perilune_train.detect.deploy", "perilune_train.motion.deploy"],
        ),
        (["bpy", "typer", "rich"], ["perilune_render.flight", "perilune_render.imaging", "perilune_render.labels"]),
        (["bpy", "typer", "rich"], ["perilune_render.engines.frame_source", "perilune_render.dataset.develop"]),
    ],
)
def test_a_room_needs_no_more_than_it_says(blocked, modules):
    code = BLOCKED.format(blocked=blocked, modules=modules)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
