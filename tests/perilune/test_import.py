"""`import perilune` loads no part; a part that is missing is named with the command that installs it."""

import pickle
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import perilune
import perilune_shared

ROOT = Path(__file__).parents[2]


def run(code: str) -> subprocess.CompletedProcess:
    """Run Python code in another process with this process's path."""
    return subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path[:0] = {sys.path!r}\n{code}"], capture_output=True, text=True
    )


def test_the_import_loads_neither_parts_nor_large_libraries():
    done = run("import perilune; sys.stdout.write(' '.join(sys.modules))")
    loaded = {name.split(".")[0] for name in done.stdout.split()}
    assert "perilune" in loaded, done.stderr
    assert not loaded & {"torch", "bpy", "numba", "numpy", "pandas", "cv2", "perilune_render", "perilune_train"}


@pytest.mark.parametrize(
    ("missing", "use", "extra"),
    [
        ("perilune_render", "from perilune import Scene", "render"),
        ("numba", "import perilune; perilune.Scene('mare')", "render"),
        ("perilune_train", "import perilune; perilune.load_detector()", "train"),
        ("torch", "import perilune; perilune.load_detector()", "train"),
    ],
)
def test_a_missing_part_is_named_with_what_to_install(missing, use, extra):
    done = run(f"sys.modules[{missing!r}] = None\n{use}")
    assert done.returncode == 1
    assert f"pip install 'perilune[{extra}]'" in done.stderr.splitlines()[-1]
    assert "During handling" not in done.stderr and "direct cause" not in done.stderr


def test_a_dataset_without_the_trainer_says_what_to_install(quick):
    opened = f"perilune.open_dataset({str(quick / 'detect')!r})"
    code = f"sys.modules['perilune_train'] = None\nimport perilune; {opened}.torch()"
    assert (
        "expected perilune_train: `make setup` in a checkout of perilune, or pip install 'perilune[train]'"
        in run(code).stderr
    )


def test_only_public_names_are_listed_and_each_has_an_explanation():
    names = dir(perilune)
    assert names == sorted(perilune.__all__) and not [name for name in names if name.startswith("_")]
    assert all(getattr(perilune, name).__doc__ for name in names)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        perilune.nothing  # noqa: B018


def test_errors_have_fields_and_reach_other_processes():
    with pytest.raises(perilune.UserError) as raised:
        perilune.look_down(altitude_m=-1)
    assert (raised.value.where, raised.value.field, raised.value.found) == ("look_down", "altitude_m", "-1")
    assert str(pickle.loads(pickle.dumps(raised.value))) == str(raised.value)  # noqa: S301 - our own


def test_the_package_requires_its_parts_in_its_own_version():
    project = tomllib.loads((ROOT / "perilune/pyproject.toml").read_text())["project"]
    version = perilune.__version__
    assert version == perilune_shared.__version__
    assert project["dependencies"] == [f"perilune-shared=={version}"]
    extras = project["optional-dependencies"]
    assert set(extras) == {"render", "blender", "train", "all"}
    assert all(each.endswith(f"=={version}") for names in extras.values() for each in names)
