"""A landing in closed loop: guidance uses the estimate of the navigation filter, which uses images.

    python examples/closed_loop.py [--out runs/closed-loop] [--seed 0]

The lander starts 1400 m above the site and flies to a gate 150 m above the site in 60 s. The attitude is level except
for a small sway. The initial estimate of the position has an error of 60 m on each axis (one standard deviation). Each
second, the filter receives an image from the image server, finds craters with the installed detector, and matches them
to a catalogue with errors. Between the images, it integrates the inertial measurements. Guidance applies the quadratic
law of Klumpp (1974, doi 10.1016/0005-1098(74)90019-3) to the filter's estimate. A second flight without camera is the
control. The program prints the distance by which each flight misses the gate, and draws both paths.
"""

import argparse
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from perilune_shared.client import SceneClient
from perilune_shared.console.progress import say
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY
from perilune_shared.geometry.frames import Array, matrix_from_rotation_vector, quaternion_from_matrix, rotation_vectors
from perilune_shared.geometry.gravity import gravity_mps2
from perilune_shared.geometry.inertial_errors import drawn_errors
from perilune_shared.geometry.inertial_grades import GRADES
from perilune_train.detect.finished_run import config_of_run, raw_threshold
from perilune_train.detect.images.predict import above
from perilune_train.detect.inference.detector import open_detector
from perilune_train.detect.inference.tiles import detect_image
from perilune_train.detect.inference.tiling import Tiling
from perilune_train.landing.craters.catalogue import Catalogue, CatalogueErrors, with_errors
from perilune_train.landing.craters.sightings import Sightings
from perilune_train.landing.filter.lander import RANGE_SIGMA_M, RELIEF_M, Lander, Surroundings
from perilune_train.landing.filter.propagate import Increments, InertialNoise, start_sigmas
from perilune_train.landing.filter.state import State
from perilune_train.shipped.models import shipped_run
from perilune_train.training.runs import RunFolder

SCENE = Path(__file__).with_name("closed_loop.yaml")
START_M, START_MPS = np.array([520.0, -260.0, 1400.0]), np.array([-14.0, 7.0, -24.0])
GATE_M, GATE_MPS = np.array([0.0, 0.0, 150.0]), np.array([0.0, 0.0, -3.0])
DURATION_S, STEP_S, FRAME_S = 60.0, 0.02, 1.0
PRIOR_M, PRIOR_MPS, PRIOR_DEG = 60.0, 0.5, 0.5
"""Standard deviations of the initial estimate of position, velocity and attitude, on each axis."""
MAX_THRUST_MPS2, RANGE_NOISE_M = 6.0, 0.5
DRAWN_S = (0.0, 30.0, 60.0)
"""Times of the frames in the picture."""
LAST_S = 4.0
"""Guidance keeps its last command if less time remains, since the law divides by the remaining time."""


@dataclass(frozen=True)
class DrawnFrame:
    """A frame for the picture."""

    height_m: float
    """Height of the lander above the site, metres."""
    image: np.ndarray
    """Grey values (h, w)."""
    boxes: Array
    """Detected craters (N, 4): left, top, right and bottom edge, pixels."""


@dataclass
class Flight:
    """Record of a flight."""

    true_m: list[Array] = field(default_factory=list)
    """True position at each frame (3,), O_L, metres."""
    estimated_m: list[Array] = field(default_factory=list)
    """Estimated position at each frame (3,), O_L, metres."""
    matched: list[int] = field(default_factory=list)
    """Number of matched craters in each frame."""
    drawn: list[DrawnFrame] = field(default_factory=list)
    """Frames for the picture."""

    @property
    def miss_m(self) -> float:
        """Distance from the gate at the end, metres."""
        return float(np.linalg.norm(self.true_m[-1] - GATE_M))

    @property
    def errors_m(self) -> Array:
        """Distance of the estimated from the true position at each frame (N,), metres."""
        return np.linalg.norm(np.array(self.true_m) - np.array(self.estimated_m), axis=1)


@contextmanager
def server() -> Iterator[str]:
    """Run a server of the scene in another process; yield its address."""
    program = Path(sys.executable).parent / "perilune-render"
    command = [str(program), "serve", "--scene", str(SCENE), "--port", "0", "--native-port", "0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            printed = ""
            for line in process.stderr:
                printed = line
                match = re.search(r"perilune_shared\.client at (tcp://\S+)", line)
                if match:
                    yield match[1]
                    break
            else:
                raise UserError("server", "start", printed.strip(), "a server that starts")
        finally:
            process.terminate()


def guidance(position_m: Array, velocity_mps: Array, left_s: float) -> Array:
    """Return the thrust per mass (3,), O_L, m/s^2, that leads to the gate in `left_s` seconds.

    The lander then has the velocity GATE_MPS, unless the thrust is limited to MAX_THRUST_MPS2.
    """
    gravity = gravity_mps2(position_m[2])
    to_go = GATE_M - position_m - velocity_mps * left_s
    faster = GATE_MPS - velocity_mps
    thrust = 6 * to_go / left_s**2 - 2 * faster / left_s - gravity
    return thrust * min(1.0, MAX_THRUST_MPS2 / float(np.linalg.norm(thrust)))


def sway(time_s: float) -> Array:
    """Return rotation_site_from_body (3, 3): level, except for a sway of half a degree."""
    angle = np.radians(0.5) * np.array([np.sin(time_s / 4), np.sin(time_s / 5 + 1), 0.3 * np.sin(time_s / 7)])
    return matrix_from_rotation_vector(angle)


def lander_of(scene: SceneClient, catalogue: Catalogue, rng: np.random.Generator) -> Lander:
    """Return the filter; its initial estimate has a random error."""
    unit = GRADES["tactical"]
    sigmas = start_sigmas(PRIOR_M, PRIOR_MPS, PRIOR_DEG, unit)
    tilt = matrix_from_rotation_vector(np.radians(PRIOR_DEG) * rng.normal(size=3))
    start = START_M + PRIOR_M * rng.normal(size=3), START_MPS + PRIOR_MPS * rng.normal(size=3), sway(0.0) @ tilt
    around = Surroundings(scene.scene().camera, ROTATION_CAMERA_FROM_BODY, catalogue, RANGE_SIGMA_M, RELIEF_M)
    return Lander(State.starting(*start, sigmas, RELIEF_M), InertialNoise.of(unit), around)


class CraterCamera:
    """Camera of the lander, with images from the server and craters from the installed detector."""

    def __init__(self, scene: SceneClient):
        run = shipped_run("detect")
        config = config_of_run(run)
        self._scene, self._threshold = scene, raw_threshold(run)
        self._detector = open_detector(RunFolder(run).best, config)
        self._tiling = Tiling(scales=tuple(config.evaluation.scales))

    def look(
        self, position_m: Array, rotation_site_from_body: Array, velocity_mps: Array
    ) -> tuple[Sightings, DrawnFrame]:
        """Return the craters in the image from a true pose, and the frame for the picture."""
        rotation = ROTATION_CAMERA_FROM_BODY @ rotation_site_from_body.T
        frame = self._scene.frame(position_m, quaternion_from_matrix(rotation), velocity_mps=velocity_mps)
        detections = above(detect_image(self._detector, frame.image, self._tiling), self._threshold)
        boxes = np.asarray(detections.boxes, np.float64)
        sigmas_px = None if detections.shapes is None else detections.shapes[:, 1:3]
        return Sightings.of_boxes(boxes, detections.scores, sigmas_px), DrawnFrame(
            float(position_m[2]), frame.image, boxes
        )


def fly(scene: SceneClient, lander: Lander, camera: CraterCamera | None, seed: int) -> Flight:
    """Simulate a flight and return its record.

    Without a camera, the filter uses only the inertial unit and the altimeter.
    """
    rng = np.random.default_rng([seed, 2])
    n_steps = round(DURATION_S / STEP_S)
    gyro, force = drawn_errors(GRADES["tactical"], np.full(n_steps, STEP_S), rng)
    position, velocity, flight = START_M.copy(), START_MPS.copy(), Flight()
    thrust = np.zeros(3)
    for step in range(n_steps + 1):
        time_s = step * STEP_S
        if step % round(FRAME_S / STEP_S) == 0:
            ground = float(scene.heights(position[:1], position[1:2])[0])
            lander.range(position[2] - ground + RANGE_NOISE_M * rng.normal())
            located = None
            if camera is not None:
                sightings, drawn = camera.look(position, sway(time_s), velocity)
                located = lander.sightings(sightings)
                if time_s in DRAWN_S:
                    flight.drawn.append(drawn)
            flight.true_m.append(position.copy())
            flight.estimated_m.append(lander.state.position_m.copy())
            flight.matched.append(len(located.fix.crater) if located else 0)
            if camera is not None:
                say(
                    f"{time_s:3.0f} s, height {position[2]:6.1f} m, error {flight.errors_m[-1]:6.2f} m, "
                    f"{flight.matched[-1]} craters matched"
                )
        left_s = DURATION_S - time_s
        if left_s > LAST_S:
            thrust = guidance(lander.state.position_m, lander.state.velocity_mps, left_s)
        if step < n_steps:
            before, after = sway(time_s), sway(time_s + STEP_S)
            rate = rotation_vectors(before.T @ after) / STEP_S + gyro[step]
            sensed = sway(time_s + STEP_S / 2).T @ thrust + force[step]
            lander.inertial(Increments.single(time_s + STEP_S, STEP_S, rate, sensed))
            acceleration = thrust + gravity_mps2(position[2])
            position = position + velocity * STEP_S + acceleration * STEP_S**2 / 2
            velocity = velocity + acceleration * STEP_S
    return flight


def draw(path: Path, flown: dict[str, Flight]) -> None:
    """Draw paths and errors of both flights, and below them frames with the detected craters."""
    figure = Figure(figsize=(12, 8.5), layout="constrained")
    (side, top, error), below = figure.subplots(2, 3)
    for (name, flight), colour in zip(flown.items(), ("tab:blue", "tab:orange"), strict=True):
        true = np.array(flight.true_m)
        side.plot(np.hypot(true[:, 0], true[:, 1]), true[:, 2], color=colour, label=name)
        top.plot(true[:, 0], true[:, 1], color=colour)
        error.semilogy(np.arange(len(true)) * FRAME_S, flight.errors_m, color=colour)
    side.plot(0, GATE_M[2], "k+", markersize=12, label="gate")
    top.plot(0, 0, "k+", markersize=12)
    side.set(xlabel="horizontal distance from the site (m)", ylabel="height (m)", title="path from the side")
    top.set(xlabel="x, west (m)", ylabel="y, south (m)", title="path from above")
    top.axis("equal")
    error.set(xlabel="time (s)", ylabel="error of the estimate (m)", title="navigation")
    side.legend()
    for axes in (side, top, error):
        axes.grid(alpha=0.3)
    for axes, drawn in zip(below, flown["with camera"].drawn, strict=True):
        axes.imshow(drawn.image, cmap="gray")
        for left, upper, right, lower in drawn.boxes:
            axes.add_patch(Rectangle((left, upper), right - left, lower - upper, fill=False, edgecolor="tab:cyan"))
        axes.set(title=f"frame at {drawn.height_m:.0f} m, {len(drawn.boxes)} detections", xticks=[], yticks=[])
    figure.savefig(path, dpi=90)


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, default=Path("runs/closed-loop"))
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    say("starting the server")
    flown = {}
    with server() as address, SceneClient(address) as scene:
        craters = scene.craters()
        large = np.flatnonzero(craters["diameter_m"] >= 5)
        large = large[np.argsort(-craters["diameter_m"][large])]
        places, normals = (
            np.stack([craters[name][large] for name in names], axis=1)
            for names in (("x_m", "y_m", "z_m"), ("normal_x", "normal_y", "normal_z"))
        )
        exact = Catalogue(places, normals, craters["diameter_m"][large] / 2, 0.0, 0.0)
        for name, camera in (("with camera", CraterCamera(scene)), ("without camera", None)):
            rng = np.random.default_rng([arguments.seed, 1])
            catalogue = with_errors(exact, CatalogueErrors(), rng)
            flown[name] = fly(scene, lander_of(scene, catalogue, rng), camera, arguments.seed)
    figures = {
        name: {"miss_m": flight.miss_m, "error_at_the_end_m": float(flight.errors_m[-1])}
        for name, flight in flown.items()
    }
    (arguments.out / "closed_loop.json").write_text(json.dumps(figures, indent=2) + "\n")
    draw(arguments.out / "closed_loop.png", flown)
    for name, flight in flown.items():
        say(f"{name}: misses the gate by {flight.miss_m:.1f} m; error of the estimate {flight.errors_m[-1]:.1f} m")
    say(f"look at {arguments.out / 'closed_loop.png'}")


if __name__ == "__main__":
    main()
