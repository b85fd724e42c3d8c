"""The command `perilune-render serve`."""

from typing import TYPE_CHECKING, Annotated, Literal

import typer

from perilune_render.cli.frames import CameraFile, Scene, read_camera
from perilune_render.cli.options import Catalogue, Dem, Preset, Setting, Unit, resolved_config, with_unit
from perilune_render.config.cameras import MAX_PINHOLE_FOV_DEG
from perilune_render.config.scene import SceneConfig
from perilune_shared.console.progress import say
from perilune_shared.errors import UserError

if TYPE_CHECKING:
    from perilune_render.server.simulation import SimulatedScene
    from perilune_shared.geometry.frames import Array

_PORT = 10363
_NATIVE_PORT = 10364
_LOOPBACK = "127.0.0.1"
_LOCAL_HOSTS = (_LOOPBACK, "::1", "localhost")
"""Loopback addresses, which only this machine can reach."""
_Zero = Literal["clockwise-from-y", "anticlockwise-from-x"]


def serve(
    scene: Scene = None,
    camera: CameraFile = None,
    preset: Preset = "small",
    setting: Setting = None,
    dem: Dem = None,
    height_unit: Unit = None,
    catalogue: Catalogue = None,
    engine: Annotated[
        Literal["heightfield", "cycles"], typer.Option(help="Rendering engine; `cycles` needs Blender and is slower.")
    ] = "heightfield",
    host: Annotated[
        str, typer.Option(help="Address to listen on; other machines can connect unless it is a loopback address.")
    ] = _LOOPBACK,
    port: Annotated[int, typer.Option(min=0, max=65535, help="PANGU: port; 0 takes a free port.")] = _PORT,
    native_port: Annotated[
        int,
        typer.Option(min=0, max=65535, help="Port of the interface for `perilune_shared.client`; 0 takes a free port."),
    ] = _NATIVE_PORT,
    sun_azimuth: Annotated[
        _Zero, typer.Option(help="PANGU: direction in which the Sun's azimuth is 0, and the sense in which it grows.")
    ] = "clockwise-from-y",
    roll: Annotated[
        Literal["left", "right"], typer.Option(help="PANGU: side to which positive roll tilts the camera's top.")
    ] = "left",
    allow_quit: Annotated[bool, typer.Option("--allow-quit", help="PANGU: let a client end the server.")] = False,
    max_clients: Annotated[int, typer.Option(min=1, max=1000, help="Maximum number of connected clients.")] = 16,
    idle_s: Annotated[
        float, typer.Option(min=1, help="Time without a request after which a client is disconnected, seconds.")
    ] = 600.0,
    kind: Annotated[
        Literal["detect", "nav"],
        typer.Option(
            help="Dataset whose descents the ground fits, unless dataset.scene.views is set, and from whose settings"
            " the Suns of further scenes are drawn."
        ),
    ] = "nav",
    scenes: Annotated[
        int,
        typer.Option(min=1, max=2**31, help="Number of scenes from which clients of `perilune_shared.client` choose."),
    ] = 1,
) -> None:
    """Serve images from any pose over a scene to PANGU clients and to `perilune_shared.client`."""
    config = resolved_config(preset, scene, with_unit(setting, height_unit), dem, catalogue, given_scene=True)
    if config.cameras:
        expected = "null: the server has one dataset.camera"
        raise UserError("configuration", "dataset.cameras", ", ".join(config.cameras), expected)
    if camera is not None:
        config = config.model_copy(update={"camera": read_camera(camera)})
    config = config.model_copy(update={"render": config.render.model_copy(update={"engine": engine})})
    from perilune_render.server.connection import Connection, Limits
    from perilune_render.server.grounds import Grounds
    from perilune_render.server.native.serve import Native, native_address
    from perilune_render.server.pangu.serve import greets, serve_pangu
    from perilune_render.server.pangu.session import Conventions, Session
    from perilune_render.server.serve import Interface, Server
    from perilune_render.server.simulation import open_simulation

    conventions = Conventions(sun_azimuth, roll, allow_quit)
    limits = Limits(clients=max_clients, idle_s=idle_s)
    with open_simulation(config, kind) as simulated, Grounds(simulated, scenes, say, kind) as grounds:
        say("rendering a first frame")
        simulated.prepare()
        start = _start(simulated)

        async def handle(connection: Connection) -> None:
            await serve_pangu(connection, lambda: Session(simulated, *start, conventions), server.stop)

        pangu = Interface("PANGU", host, port, handle, greets, limits)
        native = Native(grounds, limits, say, [pangu])
        native_interface = native.interface(host, native_port)
        server = Server(native.interfaces, say)
        server.begin()
        stated = config.scene or SceneConfig()
        say(
            f"PANGU protocol 1.20 at {host}:{pangu.port}, {engine}, images of {config.camera.width_px} x "
            f"{config.camera.height_px} px; Ctrl-C ends it"
        )
        say(
            f"the world is O_L, metres; Sun at azimuth {stated.sun_azimuth_deg:g} (clockwise from north), elevation "
            f"{stated.sun_elevation_deg:g} degrees, until a client sets it"
        )
        say(
            "PANGU does not document these conventions, so they are options: "
            f"--sun-azimuth {sun_azimuth}, --roll {roll}; cameras 0 and 1 are one camera, and each client has its own "
            "camera and Sun"
        )
        say(
            "PANGU does not document these either; here they are fixed: first viewpoint 1000 m above the site, "
            "straight down; a pulse that misses has range 0 and cosine 0; error codes 1 (refused) and 2 (faulty); for "
            "the rest see docs/reference/pangu.md"
        )
        say(f"perilune_shared.client at {native_address(host, native_interface.port)}")
        if host not in _LOCAL_HOSTS:
            say(f"{host}: others on the network can connect; the protocol has no password", style="yellow")
        server.run()


def _start(simulated: "SimulatedScene") -> tuple[int, int, float, "Array", int]:
    """Width and height (pixels), field of view (radians), Sun and random seed for a new PANGU client."""
    import numpy as np

    from perilune_render.poses.plan import trajectory_seed
    from perilune_shared.geometry.frames import sun_direction

    camera, stated = simulated.config.camera, simulated.config.scene or SceneConfig()
    sun = sun_direction(stated.sun_azimuth_deg, stated.sun_elevation_deg)
    field_of_view_rad = float(np.radians(min(camera.horizontal_fov_deg, MAX_PINHOLE_FOV_DEG)))
    return camera.width_px, camera.height_px, field_of_view_rad, sun, trajectory_seed(simulated.scene.seed, 0)
