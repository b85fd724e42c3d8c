"""Run a script in two processes, as torchrun does, forked from one that has imported torch: that saves seconds."""

import multiprocessing
import os
import runpy
import socket
import subprocess
import sys
import time
from pathlib import Path

_IMPORTED = ["torch", "pandas", "pyarrow.parquet", "pydantic", "cv2", "scipy.ndimage"]
"""Not Lightning, which reads the number of its process when it is imported."""


def run(script: Path, log: Path, *arguments: str, timeout_s: float = 120) -> subprocess.CompletedProcess[str]:
    """Run `script` in two processes with torchrun's environment variables; `log` receives their output.

    If one ends with an error, the other is terminated. The exit code is not 0 then.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_IMPORTED)
    log.touch()
    started = [context.Process(target=_main, args=(script, log, arguments, k, port)) for k in (0, 1)]
    for process in started:
        process.start()
    end = time.monotonic() + timeout_s
    while any(process.is_alive() for process in started):
        if time.monotonic() > end or any(process.exitcode for process in started):
            for process in started:
                process.terminate()
        for process in started:
            process.join(0.05)
    codes = [process.exitcode for process in started]
    return subprocess.CompletedProcess([str(script), *arguments], max(map(abs, codes)), "", log.read_text())


def _main(script: Path, log: Path, arguments: tuple[str, ...], number: int, port: int) -> None:
    ranks = {name: str(number) for name in ("RANK", "LOCAL_RANK", "ROLE_RANK")}
    sizes = {name: "2" for name in ("WORLD_SIZE", "LOCAL_WORLD_SIZE", "ROLE_WORLD_SIZE")}
    place = {"GROUP_RANK": "0", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "TORCHELASTIC_RUN_ID": "none"}
    os.environ.update(ranks | sizes | place | {"OMP_NUM_THREADS": "1"})
    with log.open("a") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    import torch

    torch.set_num_threads(1)
    sys.argv = [str(script), *arguments]
    runpy.run_path(str(script), run_name="__main__")
