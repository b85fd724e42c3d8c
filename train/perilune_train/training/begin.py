"""Decide whether to resume, keep, replace or reject an existing run with the requested name."""

import contextlib
import functools
import json
import shutil
from collections.abc import Iterator, Mapping
from typing import Any, Literal

import torch

from perilune_shared.config.resolve import Section, read_config_file, to_yaml
from perilune_shared.console.terminal import say
from perilune_shared.dataset.info_file import INFO_NAME
from perilune_shared.errors import UserError
from perilune_shared.run_record import run_record
from perilune_shared.storage.files import sha256_of, write_text
from perilune_shared.storage.locks import LOCK_NAME, locked
from perilune_shared.storage.store import Address, open_store
from perilune_train.training.runs import RunFolder, is_first_process

State = Literal["new", "resume", "finished"]
Hashes = Mapping[str, str | None]
"""SHA-256 of each input of a run; None if it is missing."""

_NO_EFFECT_ON_RESULT = {
    f"{task}.{setting}" for task in ("detect", "navigate") for setting in ("workers", "checkpoint_minutes")
} | {f"{server}.{setting}" for server in ("detect.fresh", "navigate.stream") for setting in ("address", "timeout_s")}
"""Settings that change how a run proceeds, but not its result."""
_REPLACE = "; --overwrite replaces the run"
_STATE_KEY = "perilune/run"


def hashes_of(inputs: Mapping[str, Address | None]) -> dict[str, str | None]:
    """SHA-256 of each input: of a file, or of dataset.json if the input is a dataset (a folder or an address)."""
    return {name: None if address is None else _hash_of(address) for name, address in inputs.items()}


def _hash_of(address: Address) -> str | None:
    store = open_store(address)
    if store.folder is None:
        return store.sha256(INFO_NAME) if store.exists(INFO_NAME) else None
    file = store.folder / INFO_NAME if store.folder.is_dir() else store.folder
    return sha256_of(file) if file.is_file() else None


@contextlib.contextmanager
def held(*folders: RunFolder) -> Iterator[None]:
    """Lock the folders of runs within the block, so that no second training writes into them.

    If several processes train together, only the first process holds the locks. Raises UserError if another training
    holds a lock.
    """
    with contextlib.ExitStack() as locks:
        for run in folders if is_first_process() else ():
            locks.enter_context(locked(run.root))
        yield


def state_of(run: RunFolder, task: str, config: Section, inputs: Hashes, overwrite: bool = False) -> State:
    """Decide what to do with a run's folder; all processes get the same decision.

    new: start from the beginning, because there is no saved state or `overwrite` is given. resume: continue from
    last.ckpt. finished: leave the run unchanged and print a message.

    Raises UserError if the existing run has other settings or inputs, or if the folder is not a run of this task. Also
    raises it if the first process resumes and this process finds no last.ckpt; this happens if several machines train
    without a shared folder.
    """
    if is_first_process():
        state = _decide(run, task, config, inputs, overwrite)
        if torch.distributed.is_torchelastic_launched():
            _store().set(f"{_STATE_KEY}/{run.root.name}", state)
    elif torch.distributed.is_torchelastic_launched():
        state = _store().get(f"{_STATE_KEY}/{run.root.name}").decode()
    else:
        # Lightning starts these processes on the machine of the first process, which has already prepared the folder.
        state = "resume" if run.last.is_file() else "new"
    if state == "resume" and not run.last.is_file():
        expected = "the file of the first process: share the runs folder between the machines, or copy it"
        raise UserError(run.last, "last state", "no such file", expected)
    if state == "finished":
        say(f"{run.root}: finished, left unchanged; --overwrite replaces it")
    elif state == "resume":
        say(f"{run.root}: resuming")
    return state


def start_run(run: RunFolder, task: str, config: Section, inputs: Hashes, state: State) -> None:
    """Prepare the folder of a run. If `state` is new, remove an older run and write config.yaml and inputs.json.

    If there are several processes, only the first changes the folder. Raises UserError if the folder is not a run of
    this task.
    """
    # Record the commit before training: the checkout may change during it.
    run_record()
    if not is_first_process() or state != "new":
        return
    if _is_used(run):
        _check_own(run, task)
        for path in run.root.iterdir():
            if path.name.startswith(LOCK_NAME):
                continue
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()
    write_text(run.inputs, json.dumps(dict(inputs), indent=2) + "\n")
    write_text(run.config, to_yaml(task, config))


@functools.cache
def _store() -> Any:
    """The key-value store of torchrun. Unlike torch's process group, it is available before training starts."""
    return next(torch.distributed.rendezvous("env://"))[0]


def _decide(run: RunFolder, task: str, config: Section, inputs: Hashes, overwrite: bool) -> State:
    if not _is_used(run):
        return "new"
    _check_own(run, task)
    damaged, finished = run.damaged, run.finished
    # Without a saved state, a new training would replace the weights. Metrics alone can be computed again.
    lost = damaged == run.best or (run.best.is_file() and not run.last.is_file())
    if damaged is not None and lost and not overwrite:
        raise UserError(damaged, "file", "an empty or damaged file", f"a whole file of the run{_REPLACE}")
    # A run without a saved state may be replaced even if its settings differ.
    if overwrite or not (finished or run.last.is_file()):
        return "new"
    check_settings(run, task, config)
    _check_inputs(run, inputs, skip_missing=finished)
    return "finished" if finished else "resume"


def _is_used(run: RunFolder) -> bool:
    # Ignore names that begin with a dot: a process that is killed at its start may leave such a temporary file.
    return run.root.is_dir() and any(not path.name.startswith(".") for path in run.root.iterdir())


def _check_own(run: RunFolder, task: str) -> None:
    """Raise UserError unless the folder is a run of this task, whose config.yaml has only the section of the task."""
    expected = f"another name: only a {task} run is resumed or replaced"
    if not run.config.is_file():
        # A folder with only inputs.json belongs to a run that was killed before it wrote config.yaml.
        if [path.name for path in run.root.iterdir() if not path.name.startswith(".")] == [run.inputs.name]:
            return
        raise UserError(run.root, "--name", "a folder that is not a run (no config.yaml)", expected)
    sections = list(read_config_file(run.config))
    if sections != [task]:
        raise UserError(run.config, "--name", f"the sections {', '.join(sections) or 'none'}", expected)


def check_settings(run: RunFolder, task: str, config: Section) -> None:
    """Compare an older run, if there is one, with `config`. Raises UserError with the first setting that differs.

    A setting that is missing in config.yaml was added after the run; the run used the default of this setting.
    """
    if not run.config.is_file():
        return
    for key, old, new in _differences(task, read_config_file(run.config).get(task, {}), config):
        if key not in _NO_EFFECT_ON_RESULT:
            raise UserError(run.config, key, new, f"{old}, as in the existing run{_REPLACE}")


def _check_inputs(run: RunFolder, inputs: Hashes, skip_missing: bool) -> None:
    """Compare the inputs with inputs.json. Raises UserError with the first input whose hash differs.

    With `skip_missing`, inputs that are missing now, or were missing when the run started, are not compared.
    """
    if not run.inputs.is_file():
        return
    try:
        began = json.loads(run.inputs.read_text(encoding="utf-8"))
    except (ValueError, RecursionError):
        began = None
    if not isinstance(began, dict):
        raise UserError(run.inputs, "content", "no JSON object", f"the hashes of the run's inputs{_REPLACE}")
    for name, hash_now in inputs.items():
        hash_then = began.get(name, hash_now)
        if hash_now == hash_then or (skip_missing and None in (hash_now, hash_then)):
            continue
        got = "nothing" if hash_now is None else f"SHA-256 {hash_now[:12]}"
        then = "nothing" if hash_then is None else str(hash_then)[:12]
        raise UserError(run.inputs, name, got, f"{then}, as in the existing run{_REPLACE}")


def _differences(where: str, old: Mapping[str, Any], config: Section) -> Iterator[tuple[str, object, object]]:
    """Key, old value and new value of each setting in which a dictionary of settings differs from a section."""
    plain = config.model_dump(mode="json")
    for name, field in type(config).model_fields.items():
        key, value = f"{where}.{name}", getattr(config, name)
        if isinstance(value, Section) and isinstance(old.get(name), dict):
            yield from _differences(key, old[name], value)
        elif name in old and old[name] != plain[name]:
            yield key, old[name], plain[name]
        elif name not in old and value != field.get_default(call_default_factory=True):
            yield key, "nothing", plain[name]
    for name in sorted(old.keys() - plain.keys()):
        yield f"{where}.{name}", old[name], "no such setting"
