"""The command `perilune-render status`."""

from typing import Annotated

import typer

from perilune_shared.console.terminal import answer_page
from perilune_shared.storage.store import open_store


def status(
    address: Annotated[
        str, typer.Argument(help="Folder or address of a dataset, or of the folder that contains `detect` and `nav`.")
    ],
) -> None:
    """Print what is rendered, running and failed. Any machine that can read the dataset can run this."""
    from perilune_render.jobs.status import SILENT_S, datasets_below, status_of

    for store in datasets_below(open_store(address)):
        state = status_of(store)
        lines = [
            f"{store.address}: {'complete' if state.complete else 'in progress'}",
            f"  trajectories  {state.n_done} of {state.n_trajectories} done, {len(state.running)} running, "
            f"{len(state.failed)} failed",
            f"  frames        {state.frames_done} of {state.n_frames}",
        ]
        if state.left_s is not None:
            lines.append(f"  speed         {state.frames_per_s:.1f} frames/s, {state.left_s / 3600:.2f} hours left")
        lines += [f"  running       {name}" for name in state.running]
        if state.n_silent:
            lines.append(f"  silent        {state.n_silent} processes, for {SILENT_S:.0f} s or more")
        lines += [f"  failed        {name}: {error}" for name, error in state.failed.items()]
        # Other processes wrote the names and messages. Remove line breaks, which could imitate further output lines.
        answer_page("\n".join("".join(line.splitlines()) for line in lines))
