"""Further scenes of a server: seeds, Suns, several clients, memory, requests that are refused."""

import json

import numpy as np
import pytest
from tests.helpers.scenes import config_with
from tests.render.server.native_running import NativeRunning

from perilune_render.config.values import Span
from perilune_render.flight.plan import make_plan
from perilune_render.poses.plan import scene_seed
from perilune_render.server.grounds import MAX_KEPT, Grounds, served_scene
from perilune_render.server.simulation import SimulatedScene
from perilune_render.terrain.scene import grow_scene
from perilune_shared.client import SceneClient
from perilune_shared.errors import UserError

DOWN = (0.0, 1.0, 0.0, 0.0)
N_SCENES = MAX_KEPT + 3


@pytest.fixture(scope="module")
def grounds(simulated):
    return Grounds(simulated, N_SCENES)


@pytest.fixture(scope="module")
def address(grounds):
    running = NativeRunning(grounds)
    yield running.address
    running.close()


def image(client, scene, index=0):
    return client.frame((0, 0, 500), DOWN, index=index, scene=scene).image


def test_no_dataset_has_the_terrain_of_a_further_scene():
    for shared in (False, True):
        config = config_with(name="some", seed=3, shared_terrain=shared)
        config = config.model_copy(update={"nav": config.nav.model_copy(update={"n_scenes": 50})})
        planned = {scene.seed for kind in ("detect", "nav") for scene in make_plan(config, kind).scenes}
        served = {served_scene(config, number).seed for number in range(1, 1000)}
        assert len(served) == 999
        assert not served & (planned | {scene_seed(config)})


def test_suns_are_drawn_as_in_the_dataset_of_a_kind():
    config = config_with(name="some", seed=3)
    low, high = config.nav.sun, config.nav.sun.model_copy(update={"elevation_deg": Span(low=80.0, high=85.0)})
    config = config.model_copy(update={"detect": config.detect.model_copy(update={"sun": high})})
    for number in range(1, 20):
        of_detect, of_nav = served_scene(config, number, "detect"), served_scene(config, number)
        assert 80 <= of_detect.sun_elevation_deg <= 85 and of_detect.seed == of_nav.seed
        assert low.elevation_deg.low <= of_nav.sun_elevation_deg <= low.elevation_deg.high


def test_a_prepared_scene_opens_no_engine_for_the_first_client(simulated, monkeypatch):
    with SimulatedScene(simulated.scene, simulated.config) as own:
        own.prepare()
        monkeypatch.setattr("perilune_render.server.simulation.open_engine", None)
        running = NativeRunning(Grounds(own))
        try:
            with SceneClient(running.address) as client:
                assert image(client, 0).shape == (48, 64)
                with pytest.raises(UserError, match="TypeError"):
                    client.frame((0, 0, 500), DOWN, sun_deg=(10, 20))
        finally:
            running.close()


def test_a_further_scene_is_that_of_its_seed_under_a_drawn_sun(address, simulated):
    planned = served_scene(simulated.config, 1)
    with SceneClient(address) as client:
        assert client.scene().n_scenes == N_SCENES
        ground = client.ground(1)
        assert (ground.sun_azimuth_deg, ground.sun_elevation_deg) == (
            planned.sun_azimuth_deg,
            planned.sun_elevation_deg,
        )
        span = simulated.config.nav.sun.elevation_deg
        assert span.low <= ground.sun_elevation_deg <= span.high
        own, craters = grow_scene(simulated.config, simulated.scene.view, planned.seed), client.craters(1)
        assert (craters["diameter_m"] == own.craters.diameter_m).all()
        assert len(craters["x_m"]) != len(client.craters()["x_m"])
        assert ground.content_sha256 != client.ground(0).content_sha256 == simulated.content_sha256
        assert client.heights([30.0], [40.0], scene=1) != client.heights([30.0], [40.0])
        stated = (ground.sun_azimuth_deg, ground.sun_elevation_deg)
        lit = client.frame((0, 0, 500), DOWN, index=0, scene=1, sun_deg=stated).image
        assert (lit == image(client, 1)).all()


def test_clients_on_other_scenes_do_not_change_a_clients_frames(address, grounds):
    with SceneClient(address) as first, SceneClient(address) as second:
        plain, own = image(first, 0), image(first, 1)
        assert (plain != own).any()
        for scene in range(2, N_SCENES):
            image(second, scene)
            assert (image(first, 0) == plain).all()
        # By now scene 1 was forgotten, and is generated again.
        assert len(grounds._in_memory) == MAX_KEPT and 1 not in grounds._in_memory
        assert (image(first, 1) == own).all()
        assert len(grounds._in_memory) == MAX_KEPT


def test_a_client_has_one_scene_in_the_queue(simulated):
    grounds = Grounds(simulated, 100)
    assert [grounds.simulated(number, "first") for number in (1, 2, 3)] == [None] * 3
    assert list(grounds._waiting) == [1]
    assert grounds.simulated(4, "second") is None
    assert list(grounds._waiting) == [1, 4]
    for number in range(50, 64):
        grounds.simulated(number, number)
    assert grounds.simulated(99, "another") is None
    assert 99 not in grounds._waiting and len(grounds._waiting) == 16
    assert grounds.simulated(0, "another") is simulated


def test_a_scene_that_cannot_be_generated_is_an_error_for_those_who_ask_for_it(simulated, monkeypatch):
    grounds = Grounds(simulated, 3)
    monkeypatch.setattr(Grounds, "_new_scene", lambda self, number: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        while grounds.simulated(1, "client") is None:
            pass
    assert grounds.simulated(0, "client") is simulated
    assert grounds._waiting == {}


@pytest.mark.parametrize(
    ("scene", "message"),
    [(N_SCENES, f"below {N_SCENES}"), (-1, "scene"), (2**31, "scene"), (1.5, "scene"), ("1", "scene"), (None, "scene")],
)
def test_a_number_of_no_scene_is_refused(address, scene, message):
    with SceneClient(address) as client:
        client._socket.send(json.dumps({"request": "ground", "scene": scene}).encode())
        assert client._socket.poll(20_000)
        (reply,) = client._socket.recv_multipart()
        assert message in json.loads(reply)["error"]
        assert image(client, 0).dtype == np.uint8
