"""Hash of the code that determines a result.

The hash of some functions and classes covers them and every function, class and constant of perilune that they use,
directly or indirectly. It omits comments, docstrings, error messages and unused code. A new docstring or command
therefore does not change the hash, but a new value of a constant does, even if the constant is five calls away.
"""

import ast
import functools
import hashlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import perilune_render
import perilune_shared

FOLDERS = {module.__name__: Path(module.__path__[0]) for module in (perilune_render, perilune_shared)}
"""Folder of each package, by its name."""
_SETTINGS = "perilune_render.config."
"""Prefix of the modules of settings. A recipe records the values of all settings, so the hash omits their defaults,
bounds and checks."""
_NO_EFFECT = (
    "perilune_render.provenance.caches",
    "perilune_shared.config.",
    "perilune_shared.console.",
    "perilune_shared.errors",
    "perilune_shared.storage.files",
)
"""Modules that do not change results: they read settings, store results, or report errors and progress."""


@dataclass(frozen=True, slots=True)
class Fingerprint:
    """The code that determines a result."""

    sha256: str
    """SHA-256 of the code, hexadecimal."""
    modules: frozenset[str]
    """Modules of perilune that contain this code."""
    libraries: frozenset[str]
    """Import names of other packages that this code uses."""


@dataclass(slots=True)
class _Module:
    """One source file."""

    definitions: dict[str, list[ast.stmt]] = field(default_factory=dict)
    """Statements that define each top-level name."""
    imported: dict[str, tuple[str, str | None]] = field(default_factory=dict)
    """Source module and name of each imported name; the name is None for a whole module."""
    others: list[ast.stmt] = field(default_factory=list)
    """Top-level statements that define nothing, such as calls."""
    contents: dict[str, tuple[str, frozenset[tuple[str, ...]]]] = field(default_factory=dict)
    """Cached results of `content`."""

    def content(self, name: str) -> tuple[str, frozenset[tuple[str, ...]]]:
        """The code that defines a name, and the dotted names in this code.

        For the name "", the code is the statements that define no name.
        """
        if name not in self.contents:
            statements = self.definitions[name] if name else self.others
            names = frozenset(names for statement in statements for names in _names(statement))
            self.contents[name] = "\n".join(map(ast.dump, statements)), names
        return self.contents[name]


def fingerprint(*roots: str, folders: dict[str, Path] | None = None) -> Fingerprint:
    """The fingerprint of functions and classes, given as `package.module:name`.

    `package.module:` is a whole module. `folders` gives the folder of each package, by default the folders of the
    imported packages.
    """
    return _fingerprint(roots, tuple(sorted((folders or FOLDERS).items())))


@functools.cache
def _fingerprint(roots: tuple[str, ...], folders: tuple[tuple[str, Path], ...]) -> Fingerprint:
    walk = _Walk(dict(folders))
    for root in roots:
        module, _, name = root.partition(":")
        walk.follow(module, (name,) if name else ())
    # Omit module names and empty modules, so that moving code between files does not change the hash.
    code = "\n".join(sorted(f"{name}\n{text}" for (_, name), text in walk.code.items() if text))
    modules = frozenset(module for module, _ in walk.code)
    libraries = frozenset(walk.libraries - sys.stdlib_module_names)
    return Fingerprint(hashlib.sha256(code.encode()).hexdigest(), modules, libraries)


def compiled_functions() -> tuple[str, ...]:
    """Every function of perilune_render that numba compiles, as `package.module:name`."""
    functions = []
    root = FOLDERS["perilune_render"]
    for path in sorted(root.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        if "njit" in text:
            name = ".".join(("perilune_render", *path.relative_to(root).with_suffix("").parts))
            for function, (*_, node) in _parsed(text).definitions.items():
                if isinstance(node, ast.FunctionDef) and any("njit" in ast.dump(each) for each in node.decorator_list):
                    functions.append(f"{name}:{function}")
    return tuple(functions)


class _Walk:
    """Collects the code to which names refer, across modules."""

    def __init__(self, folders: dict[str, Path]):
        self.folders = folders
        self.code: dict[tuple[str, str], str] = {}
        self.libraries: set[str] = set()
        self.sources: dict[str, _Module | None] = {}

    def follow(self, module: str, names: tuple[str, ...]) -> None:
        """Collect the code to which a dotted name in a module refers.

        A name that the module does not define is ignored.
        """
        if module.startswith(_NO_EFFECT):
            return
        source = self._source(module)
        if source is None:
            self.libraries.add(module.partition(".")[0])
            return
        to_follow = names[:1] or (*source.definitions, *source.imported)
        for name in to_follow:
            if name in source.imported:
                self._follow_import(*source.imported[name], names[1:])
            elif name in source.definitions:
                self._take(module, name, source)
        self._take(module, "", source)

    def _follow_import(self, module: str, name: str | None, rest: tuple[str, ...]) -> None:
        if name is None:
            self.follow(module, rest)
        elif self._source(f"{module}.{name}") is not None:
            self.follow(f"{module}.{name}", rest)
        else:
            self.follow(module, (name, *rest))

    def _take(self, module: str, name: str, source: _Module) -> None:
        if (module, name) not in self.code:
            self.code[module, name], named = source.content(name)
            for names in named:
                self.follow(module, names)

    def _source(self, module: str) -> _Module | None:
        """The parsed module, or None if it does not belong to perilune."""
        if module not in self.sources:
            package, *parts = module.split(".")
            path = self.folders[package].joinpath(*parts) if package in self.folders else None
            files = [path.with_suffix(".py"), path / "__init__.py"] if path is not None else []
            text = next((file.read_text(encoding="utf-8") for file in files if file.is_file()), None)
            self.sources[module] = None if text is None else _parsed(text, module.startswith(_SETTINGS))
        return self.sources[module]


@functools.cache
def _parsed(text: str, settings: bool = False) -> _Module:
    """Parse a source file without docstrings and error messages; `settings` also omits fields and checks."""
    module, tree = _Module(), ast.parse(text)
    # Walk the whole tree to include imports inside functions.
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                bound = alias.asname or alias.name.partition(".")[0]
                module.imported[bound] = (alias.name if alias.asname else bound, None)
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                module.imported[alias.asname or alias.name] = (node.module, alias.name)
    for node in _Stripped(settings).visit(tree).body:
        if defined := _defined(node):
            for name in defined:
                module.definitions.setdefault(name, []).append(node)
        elif not isinstance(node, ast.Pass):
            module.others.append(node)
    return module


class _Stripped(ast.NodeTransformer):
    """Removes imports, bare strings (docstrings) and raised errors; for settings, also fields and checks."""

    def __init__(self, settings: bool):
        self.settings = settings

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.AST:
        self.generic_visit(node)
        if self.settings:
            plain = [each for each in node.body if isinstance(each, ast.FunctionDef) and not each.decorator_list]
            node.body = [*plain, ast.Pass()]
        return node

    def visit_Expr(self, node: ast.Expr) -> ast.AST:
        self.generic_visit(node)
        bare = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return ast.Pass() if bare else node

    def visit_Import(self, node: ast.Import) -> None:
        return None

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        return None

    def visit_If(self, node: ast.If) -> ast.AST | None:
        self.generic_visit(node)
        return None if isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING" else node

    def visit_Raise(self, node: ast.Raise) -> ast.AST:
        return ast.Raise()


def _defined(node: ast.stmt) -> list[str]:
    """Names defined by a top-level statement."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return [node.name]
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    return [each.id for target in targets for each in ast.walk(target) if isinstance(each, ast.Name)]


def _names(node: ast.AST) -> Iterator[tuple[str, ...]]:
    """Every name in a statement with its attributes, as (a, b, c) for a.b.c."""
    for each in ast.walk(node):
        if isinstance(each, ast.Name):
            yield (each.id,)
        elif isinstance(each, ast.Attribute):
            parts: list[str] = []
            base: ast.expr = each
            while isinstance(base, ast.Attribute):
                parts.append(base.attr)
                base = base.value
            if isinstance(base, ast.Name):
                yield (base.id, *reversed(parts))
