"""A server in another process whose scenes fit the drawn datasets: same camera, same descents."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

_SETTINGS = {
    "name": "fresh",
    "camera": {"width_px": 96, "height_px": 96, "horizontal_fov_deg": 40.0},
    "terrain": {"spacing_px": 4.0},
    "render": {"samples": 1, "engine": "heightfield", "threads": 1, "cache_gib": 0.0},
    "scene": {"views": [{"height_m": 300, "reach_m": 400}, {"height_m": 1600, "reach_m": 1450}]},
}


class Served:
    """A server at `address` until `stop`; the test is skipped without the renderer or the client.

    `changes` are sections of the settings of the scene to replace.
    """

    def __init__(self, folder: Path, n_scenes: int = 5, **changes: dict):
        pytest.importorskip("perilune_render", reason="needs the image server of the renderer")
        pytest.importorskip("zmq", reason="needs the extra `client`")
        path = folder / "scene.yaml"
        path.write_text(yaml.safe_dump({"dataset": _SETTINGS | changes}))
        program = Path(sys.executable).parent / "perilune-render"
        options = ["--preset", "tiny", "--port", "0", "--native-port", "0", "--scenes", str(n_scenes)]
        command = [str(program), "serve", "--scene", str(path), *options]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        assert self.process.stderr is not None
        printed = ""
        for line in self.process.stderr:
            printed += line
            if found := re.search(r"perilune_shared\.client at (tcp://\S+)", line):
                self.address = found[1]
                return
        pytest.fail(printed)

    def stop(self) -> None:
        """End the server at once."""
        self.process.kill()
        self.process.wait()
        assert self.process.stderr is not None
        self.process.stderr.close()
