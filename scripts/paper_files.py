"""Pack the results of the paper's experiment into a few small files, to copy them from a borrowed machine.

    python scripts/paper_files.py pack runs/paper-gpu OUT
    python scripts/paper_files.py unpack OUT runs/paper-gpu

`pack` writes at most eight files of at most 16 MiB: metrics.json of all runs; an archive of the page with its pictures,
settings, curves and logs; and the weights of one network, rounded to 8 bits and split into shards. `unpack` restores
the folder of the runs from these files.
"""

import gzip
import io
import json
import tarfile
from pathlib import Path
from typing import Annotated

from perilune_shared.console.interrupts import end_at_interrupt

if __name__ == "__main__":
    # An import by another module must not change how Ctrl-C works.
    end_at_interrupt()

import torch
import typer
from safetensors.torch import load, save

from perilune_shared.errors import UserError
from perilune_shared.storage.files import write_bytes
from perilune_train.training.runs import load_weights

MAX_BYTES = 16 * 2**20
METRICS, PAGE, SHARDS = "metrics.json", "page.tar.gz", "weights-*.safetensors.gz"
NETWORK = "detect/attention-yolov3"
"""Run whose weights are packed."""
_PACKED_PATTERNS = (
    "*.md",
    "*.png",
    "*.json",
    "logs/*.log",
    "detect/*/config.yaml",
    "navigate/*/config.yaml",
    "explain/*/metrics.json",
)
_MAX_SHARDS = 6

app = typer.Typer(pretty_exceptions_enable=False, add_completion=False, no_args_is_help=True)


def rounded(tensor: torch.Tensor) -> dict[str, torch.Tensor]:
    """Round weights (out, ...) to 8-bit integers with one scale per output channel; returns tensors by name ending.

    Vectors and integers stay as they are.
    """
    if tensor.ndim < 2 or not tensor.is_floating_point():
        return {"": tensor.contiguous()}
    flat = tensor.float().flatten(1)
    scale = (flat.abs().amax(1) / 127).clamp(min=1e-12)
    whole = torch.round(flat / scale[:, None]).to(torch.int8).view(tensor.shape)
    return {"": whole.contiguous(), "#scale": scale}


def restored(whole: torch.Tensor, scale: torch.Tensor | None) -> torch.Tensor:
    """Reverse `rounded`. The weights differ from the original ones by at most half the scale of their channel."""
    if scale is None:
        return whole
    return whole.float() * scale.view(-1, *[1] * (whole.ndim - 1))


@app.command()
def pack(
    runs: Annotated[Path, typer.Argument(help="Folder of the experiment's runs.")],
    out: Annotated[Path, typer.Argument(help="Folder for the files.")],
) -> None:
    """Pack metrics, page, logs and weights of the runs into a few files."""
    if not runs.is_dir():
        raise UserError(runs, "runs", "no such folder", "the folder of the experiment's runs")
    out.mkdir(parents=True, exist_ok=True)
    metrics_by_run = {
        str(path.parent.relative_to(runs)): json.loads(path.read_text()) for path in runs.rglob("metrics.json")
    }
    write_bytes(out / METRICS, json.dumps(metrics_by_run, indent=1).encode())
    with tarfile.open(out / PAGE, "w:gz") as archive:
        for path in sorted(
            {path for pattern in _PACKED_PATTERNS for path in (*runs.glob(pattern), *runs.glob(f"logs/{pattern}"))}
        ):
            if path.stat().st_size < MAX_BYTES / 8:
                archive.add(path, path.relative_to(runs))
    best = runs / NETWORK / "checkpoints" / "best.ckpt"
    if best.is_file():
        _pack_weights(best, out)
    for path in sorted(out.iterdir()):
        print(f"{path}: {path.stat().st_size / 2**20:.2f} MiB")


def _pack_weights(best: Path, out: Path) -> None:
    content = load_weights(best)
    shards: list[dict[str, torch.Tensor]] = [{}]
    size = 0
    for name, tensor in content["state_dict"].items():
        parts = {f"{name}{key}": value for key, value in rounded(tensor).items()}
        n_bytes = sum(value.numel() * value.element_size() for value in parts.values())
        if size + n_bytes > 0.99 * MAX_BYTES:
            shards.append({})
            size = 0
        shards[-1] |= parts
        size += n_bytes
    if len(shards) > _MAX_SHARDS:
        raise UserError(best, "weights", f"{len(shards)} shards", f"at most {_MAX_SHARDS} of 16 MiB")
    record = {key: json.dumps(value) for key, value in content.items() if key != "state_dict"}
    for number, shard in enumerate(shards):
        # gzip saves a seventh: most of the 8-bit weights are near 0.
        write_bytes(out / SHARDS.replace("*", str(number)), gzip.compress(save(shard, metadata=record), 4))


@app.command()
def unpack(
    files: Annotated[Path, typer.Argument(help="Folder of the files that `pack` wrote.")],
    runs: Annotated[Path, typer.Argument(help="Folder for the runs.")],
) -> None:
    """Restore page, metrics and weights in the folder of the runs."""
    if not (files / METRICS).is_file():
        raise UserError(files, METRICS, "no such file", "the folder that `pack` wrote")
    for run, metrics in json.loads((files / METRICS).read_text()).items():
        write_bytes(runs / run / "metrics.json", json.dumps(metrics, indent=2).encode())
    with tarfile.open(files / PAGE) as archive:
        archive.extractall(runs, filter="data")
    shards = [gzip.decompress(path.read_bytes()) for path in sorted(files.glob(SHARDS))]
    if shards:
        values: dict[str, torch.Tensor] = {}
        for content in shards:
            values |= load(content)
        size = int.from_bytes(shards[0][:8], "little")
        record = json.loads(shards[0][8 : 8 + size])["__metadata__"]
        state = {
            name: restored(value, values.get(f"{name}#scale"))
            for name, value in values.items()
            if not name.endswith("#scale")
        }
        saved = io.BytesIO()
        torch.save({"state_dict": state, **{key: json.loads(value) for key, value in record.items()}}, saved)
        write_bytes(runs / NETWORK / "checkpoints" / "best.ckpt", saved.getvalue())
    print(f"{runs}: page, metrics{', weights' * bool(shards)}")


if __name__ == "__main__":
    from perilune_shared.console.command_line import run_command_line

    run_command_line(app)
