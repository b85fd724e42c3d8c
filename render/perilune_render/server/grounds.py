"""The scenes of a server: scene 0 of the configuration, and further scenes that clients request by number.

A separate thread generates the further scenes, one after another, while frames are rendered. Each client has at most
one scene in the queue. The most recently used scenes stay in memory.
"""

import queue
import threading
from collections.abc import Callable

from perilune_render.config.dataset import DatasetConfig
from perilune_render.config.scene import SceneConfig
from perilune_render.flight.plan import ScenePlan, drawn_scene
from perilune_render.server.simulation import SimulatedScene
from perilune_render.terrain.cache import cached_scene
from perilune_shared.errors import UserError

MAX_KEPT = 3
"""Largest number of scenes in memory besides scene 0 and the scene that is being generated."""
MAX_WAITING = 16
"""Largest number of scenes that wait to be generated."""
_STREAM = "served"


def served_scene(config: DatasetConfig, number: int, kind: str = "nav") -> ScenePlan:
    """Random seed and Sun of the further scene `number`, from 1.

    The Sun is drawn from the settings of the dataset `kind`, such as `dataset.nav.sun`. No scene of a dataset has this
    seed, so no dataset has this terrain.
    """
    return drawn_scene(config, config.kind(kind).sun, _STREAM, number)


class Grounds:
    """The simulated scenes by number. Only the thread that renders may use it. Close it at the end."""

    def __init__(
        self,
        first: SimulatedScene,
        n_scenes: int = 1,
        note: Callable[[str], object] = lambda text: None,
        kind: str = "nav",
    ):
        """Scene 0 is `first`. The Suns of the other scenes are drawn as in the dataset `kind`, detect or nav."""
        self.first, self.n_scenes, self._note, self._kind = first, n_scenes, note, kind
        self._in_memory: dict[int, SimulatedScene] = {}
        self._waiting: dict[int, object] = {}
        self._failed: dict[int, Exception] = {}
        self._requests: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._results: queue.SimpleQueue[tuple[int, SimulatedScene | Exception]] = queue.SimpleQueue()
        self._last = first
        if n_scenes > 1:
            # A daemon, so that the server can end while a scene is being generated.
            threading.Thread(target=self._serve_requests, name="grounds", daemon=True).start()

    def __enter__(self) -> "Grounds":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the engines of all scenes."""
        for simulated in (self.first, *self._in_memory.values()):
            simulated.close()
        self._in_memory.clear()

    def simulated(self, number: int, client: object) -> SimulatedScene | None:
        """The simulated scene `number`, or None if it is not in memory yet.

        If the result is None, call again later. The call queues the scene, unless another scene of the client or
        MAX_WAITING scenes are in the queue. Raises UserError if the server has no scene of this number, and the
        original error if the scene could not be generated.
        """
        if number >= self.n_scenes:
            raise UserError("request", "scene", number, f"below {self.n_scenes}, the server's --scenes")
        self._collect()
        if number in self._failed:
            raise self._failed.pop(number)
        if number == 0 or number in self._in_memory:
            return self._used(number)
        is_full = client in self._waiting.values() or len(self._waiting) >= MAX_WAITING
        if number not in self._waiting and not is_full:
            self._waiting[number] = client
            self._requests.put(number)
        return None

    def _used(self, number: int) -> SimulatedScene:
        if number > 0:
            self._in_memory[number] = self._in_memory.pop(number)  # the most recently used scene comes last
        simulated = self._in_memory.get(number, self.first)
        if simulated is not self._last and simulated.config.render.engine == "cycles":
            self._last.close()  # Blender holds only one scene
        self._last = simulated
        return simulated

    def _collect(self) -> None:
        """Take generated scenes out of the thread's results, and drop the least recently used scenes."""
        while not self._results.empty():
            number, result = self._results.get()
            del self._waiting[number]
            if isinstance(result, Exception):
                self._failed[number] = result
                continue
            while len(self._in_memory) >= MAX_KEPT:
                self._in_memory.pop(next(iter(self._in_memory))).close()
            self._in_memory[number] = result

    def _serve_requests(self) -> None:
        """Generate requested scenes; the body of the thread."""
        while True:
            number = self._requests.get()
            try:
                self._results.put((number, self._new_scene(number)))
            except Exception as error:
                self._results.put((number, error))

    def _new_scene(self, number: int) -> SimulatedScene:
        config, view = self.first.config, self.first.scene.view
        if view is None:
            raise UserError("request", "scene", number, "0: the ground was made for no views")
        planned = served_scene(config, number, self._kind)
        sun = {"sun_azimuth_deg": planned.sun_azimuth_deg, "sun_elevation_deg": planned.sun_elevation_deg}
        lit = config.model_copy(update={"scene": (config.scene or SceneConfig()).model_copy(update=sun)})
        simulated = SimulatedScene(cached_scene(config, view, planned.seed), lit, self._note)
        _ = simulated.content_sha256  # computed here, while frames of other scenes are rendered
        return simulated
