"""Record every step of a filter as rows of the tables of a trace."""

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from perilune_shared.geometry.frames import Array, quaternion_from_matrix, rotation_vectors
from perilune_train.landing.craters.ambiguity import match_probability
from perilune_train.landing.craters.fix import PosePrior, refine
from perilune_train.landing.craters.locate import (
    Located,
    expected_error_px,
    ground_below_m,
    locate,
    weak_prior,
)
from perilune_train.landing.craters.projection import Pose
from perilune_train.landing.craters.sightings import Sightings
from perilune_train.landing.craters.vote import support
from perilune_train.landing.filter.lander import Lander, Surroundings
from perilune_train.landing.filter.measurements import camera_pose, crater_innovations
from perilune_train.landing.filter.state import N_ERRORS, State
from perilune_train.landing.filter.stretch import CORE, Stretch
from perilune_train.landing.filter.update import passes_gate
from perilune_train.landing.trace.columns import TABLES, Table, covariance_names

Row = dict[str, object]


class TraceRecorder:
    """Collects the rows of a trace of one flight; see `columns.py`."""

    def __init__(self, around: Surroundings):
        self._around = around
        self._rows: dict[str, list[Row]] = {table.name: [] for table in TABLES}
        self._n_frames, self._n_refused = 0, 0

    def tables(self) -> dict[str, pd.DataFrame]:
        """The tables of the trace by name."""
        return {table.name: _frame_of(self._rows[table.name], table) for table in TABLES}

    def step(self, stretch: Stretch, kind: str, innovation: Array, spread: Array, accepted: NDArray[np.bool_]) -> None:
        """Record a propagation or an update."""
        (state,) = stretch.states()
        self._n_refused = int(stretch.n_refused[0])
        self._add_step(kind, state, innovation[0], spread[0], accepted=bool(accepted[0]))

    def _add_step(self, kind: str, state: State, innovation: Array, spread: Array, *, accepted: bool) -> None:
        n = len(innovation)
        padded, covariance = np.full(3, np.nan), np.full((3, 3), np.nan)
        padded[:n], covariance[:n, :n] = innovation, spread
        rows = self._rows["steps"]
        rows.append(
            {
                "step": len(rows),
                "frame": self._n_frames,
                "kind": kind,
                "time_s": state.time_s,
                "accepted": int(accepted),
                **{f"innovation_{k}": padded[k] for k in range(3)},
                **_triangle("innovation_covariance", covariance),
                **_motion(state),
                **_triangle("covariance", state.covariance[np.ix_(CORE, CORE)]),
            }
        )

    def frame(self, before: State, seen: Sightings, located: Located | None, lander: Lander) -> None:
        """Record a frame. Fixes and innovations are computed again, from the state before the frame."""
        number, around, after = self._n_frames, self._around, lander.state
        self._rows["sightings"] += [
            {
                "frame": number,
                "sighting": k,
                "x_px": seen.centre_px[k, 0],
                "y_px": seen.centre_px[k, 1],
                "radius_px": seen.radius_px[k],
                "score": seen.score[k],
                "noise_px": seen.noise_px[k],
                "static_px": seen.static_px[k],
            }
            for k in range(len(seen))
        ]
        pose, by_error = camera_pose(before, around.rotation_camera_from_body)
        expected = PosePrior(pose, by_error @ before.covariance[:N_ERRORS, :N_ERRORS] @ by_error.T)
        accepted, located = located is not None, located or locate(seen, around.catalogue, around.camera, expected)
        altitude_m = max(float(pose.position_m[2] - ground_below_m(around.catalogue, pose.position_m)), 1.0)
        error_px = expected_error_px(expected, altitude_m, around.camera)
        self._add_rounds(number, seen, located, error_px)
        fits = located is not None and _fits(located, expected)
        outcome = "no_fix" if located is None else "contradiction" if not accepted else "update" if fits else "restart"
        self._add_matches(number, seen, located, before, is_used=outcome == "update")
        row = {
            "frame": number,
            "time_s": after.time_s,
            "n_sightings": len(seen),
            "n_refused": self._n_refused,
            "outcome": outcome,
            "searched": -1 if located is None else int(located.searched),
            "status": lander.status,
            "disagreeing": ", ".join(lander.disagreeing) or "none",
            **_pose("expected", pose),
            **_triangle("expected_covariance", expected.covariance),
            "expected_error_px": error_px,
            **self._of_fix(seen, located, expected),
            **_motion(after),
            **{f"common_{k}_px": after.common_px[k] for k in range(5)},
            **_named("mounting_{}_rad", "xyz", after.mounting_rad),
            "time_tag_s": after.time_tag_s,
            **_named("angular_rate_{}_radps", "xyz", after.angular_rate_radps),
            **_triangle("covariance", after.covariance[:N_ERRORS, :N_ERRORS]),
        }
        self._rows["frames"].append(row)
        for k, crater in enumerate(after.craters):
            parts = slice(N_ERRORS + 2 * k, N_ERRORS + 2 * k + 2)
            offsets = {"offset_x_m": after.offsets_m[k, 0], "offset_y_m": after.offsets_m[k, 1]}
            block = _block("covariance", after.covariance[parts, parts])
            self._rows["craters"].append({"frame": number, "crater": int(crater), **offsets, **block})
        self._add_step("frame", after, np.zeros(0), np.zeros((0, 0)), accepted=accepted)
        self._n_frames, self._n_refused = number + 1, 0

    def _of_fix(self, seen: Sightings, located: Located | None, expected: PosePrior) -> Row:
        """The columns of a frame about its fix."""
        around = self._around
        if located is None:
            names = ["rms_px", "n_by_chance", "sigma_by_chance", "fix_nis", *covariance_names("fix_covariance", 6)]
            pose = Pose(np.full(3, np.nan), np.full((3, 3), np.nan))
            return {
                **_pose("start", pose),
                **_pose("fix", pose),
                **dict.fromkeys(names, np.nan),
                "n_matched": 0,
                "n_agreed": 0,
            }
        fix = located.fix
        agreed = support(seen, around.catalogue, around.camera, fix.pose)
        innovation, spread = _innovation(located, expected)
        return {
            **_pose("start", fix.start),
            **_pose("fix", fix.pose),
            **_triangle("fix_covariance", fix.covariance),
            "fix_nis": float(innovation @ np.linalg.solve(spread, innovation)),
            "n_matched": len(fix.crater),
            "rms_px": fix.rms_px,
            "n_agreed": agreed.n_agreed,
            "n_by_chance": agreed.n_by_chance,
            "sigma_by_chance": agreed.sigma_by_chance,
        }

    def _add_rounds(self, number: int, seen: Sightings, located: Located | None, error_px: float) -> None:
        """Record the rounds of a fix; after a search, these are the rounds of its last fit."""
        if located is None:
            return
        rounds: list[Pose] = []
        start, catalogue, camera = located.fix.start, self._around.catalogue, self._around.camera
        if located.searched:
            refine(seen, catalogue, camera, weak_prior(start), start, rounds=rounds)
        else:
            refine(seen, catalogue, camera, weak_prior(start), start, error_px, rounds)
        self._rows["rounds"] += [{"frame": number, "round": k, **_pose("pose", each)} for k, each in enumerate(rounds)]

    def _add_matches(
        self, number: int, seen: Sightings, located: Located | None, before: State, *, is_used: bool
    ) -> None:
        """Record the matches of a fix, with their innovations if the update uses them."""
        if located is None:
            return
        fix, around = located.fix, self._around
        probability = match_probability(seen, around.catalogue, around.camera, fix)
        innovation, blocks = np.full((len(fix.crater), 2), np.nan), np.full((len(fix.crater), 2, 2), np.nan)
        if is_used:
            measured = crater_innovations(
                before, fix, seen, around.catalogue, around.camera, around.rotation_camera_from_body
            )
            n = len(measured.match)
            innovation[measured.match] = measured.innovation_px
            blocks[measured.match] = measured.spread.reshape(n, 2, n, 2)[np.arange(n), :, np.arange(n)]
        self._rows["matches"] += [
            {
                "frame": number,
                "sighting": int(fix.sighting[k]),
                "crater": int(fix.crater[k]),
                "weight": fix.weight[k],
                "probability": probability[k],
                "innovation_x_px": innovation[k, 0],
                "innovation_y_px": innovation[k, 1],
                **_block("innovation_covariance", blocks[k]),
            }
            for k in range(len(fix.crater))
        ]


def _innovation(located: Located, expected: PosePrior) -> tuple[Array, Array]:
    """Innovation (6,) of a fix against the expected pose, and its covariance (6, 6)."""
    fix = located.fix
    turn = rotation_vectors(fix.pose.rotation_camera_from_site @ expected.pose.rotation_camera_from_site.T)
    innovation = np.concatenate([fix.pose.position_m - expected.pose.position_m, turn])
    return innovation, expected.covariance + fix.covariance


def _fits(located: Located, expected: PosePrior) -> bool:
    return passes_gate(*_innovation(located, expected))


def _motion(state: State) -> Row:
    return {
        **_named("{}_m", "xyz", state.position_m),
        **_named("velocity_{}_mps", "xyz", state.velocity_mps),
        **_named("rotation_{}", "wxyz", quaternion_from_matrix(state.rotation_site_from_body)),
        **_named("gyro_bias_{}_radps", "xyz", state.gyro_bias_radps),
        **_named("force_bias_{}_mps2", "xyz", state.force_bias_mps2),
        "ground_m": state.ground_m,
    }


def _pose(prefix: str, pose: Pose) -> Row:
    rotation = pose.rotation_camera_from_site
    quaternion = quaternion_from_matrix(rotation) if np.isfinite(rotation).all() else np.full(4, np.nan)
    return {**_named(prefix + "_{}_m", "xyz", pose.position_m), **_named(prefix + "_rotation_{}", "wxyz", quaternion)}


def _named(form: str, axes: str, values: Array) -> Row:
    return {form.format(axis): value for axis, value in zip(axes, values, strict=True)}


def _triangle(prefix: str, covariance: Array) -> Row:
    n = len(covariance)
    return dict(zip(covariance_names(prefix, n), covariance[np.triu_indices(n)], strict=True))


def _block(prefix: str, covariance: Array) -> Row:
    names = (f"{prefix}_x_x", f"{prefix}_x_y", f"{prefix}_y_y")
    return dict(zip(names, covariance[[0, 0, 1], [0, 1, 1]], strict=True))


def _frame_of(rows: list[Row], table: Table) -> pd.DataFrame:
    """A table with the documented columns and types."""
    flat = table.flat()
    types = {name: "int64" for name in table.keys} | {
        name: object if column.is_text else "int64" if column.scale == 0 and not column.variances else "float64"
        for name, (column, _) in flat.items()
    }
    return pd.DataFrame(rows, columns=list(types)).astype(types)
