"""A worker process that kills itself after the second frame of trajectory 1, as often as KILLS has files.

It kills itself, because a parent that kills it on a message may come too late: the trajectory may be done by then.
"""

import os
import signal
from collections.abc import Callable
from pathlib import Path

from perilune_render.jobs import scene_renderer, worker
from perilune_render.jobs.scene_renderer import SceneRenderer

TRAJECTORY, AFTER_FRAMES = 1, 2


class KilledRenderer(SceneRenderer):
    """The renderer of scenes, killed within a trajectory."""

    def render(self, place: int, advance: Callable[[], None], note: Callable[[str], None]) -> list[str]:
        """As of SceneRenderer."""
        n_frames = 0

        def advance_or_die() -> None:
            nonlocal n_frames
            advance()
            n_frames += 1
            kills = sorted(Path(os.environ["KILLS"]).iterdir())
            if place == TRAJECTORY and n_frames == AFTER_FRAMES and kills:
                kills[0].unlink()
                os.kill(os.getpid(), signal.SIGKILL)

        return super().render(place, advance_or_die, note)


if __name__ == "__main__":
    scene_renderer.SceneRenderer = KilledRenderer
    worker.main()
