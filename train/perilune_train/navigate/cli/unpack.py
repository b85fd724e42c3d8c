"""`perilune-train navigate unpack`: one descent of a dataset as the files that `navigate fly` reads."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.errors import UserError
from perilune_shared.geometry.inertial_grades import GRADES
from perilune_shared.terminal import say


def unpack(
    dataset: Annotated[
        str, typer.Option(help="Dataset of descents: a folder, s3://bucket/prefix or gs://bucket/prefix.")
    ],
    trajectory: Annotated[str, typer.Option(help="scene_id/trajectory_id, for example scene-0000/trajectory-0000.")],
    out: Annotated[Path, typer.Option(help="New folder for the files.")] = Path("descent"),
    grade: Annotated[str, typer.Option(help="Grade of the inertial unit.")] = "tactical",
    exact: Annotated[bool, typer.Option("--exact", help="Write the catalogue without errors.")] = False,
    position_m: Annotated[float, typer.Option(help="Deviation of the prior's position on each axis.")] = 60.0,
    velocity_mps: Annotated[float, typer.Option(help="Deviation of the prior's velocity on each axis.")] = 1.0,
    attitude_deg: Annotated[float, typer.Option(help="Deviation of the prior's attitude on each axis.")] = 0.5,
    seed: Annotated[int, typer.Option(help="Seed of the prior and of the errors of the catalogue.")] = 0,
) -> None:
    """Write a descent as frames/, camera.yaml, catalogue.parquet, imu.csv, ranges.csv, prior.yaml and truth.csv.

    The prior is off by random errors; the catalogue has those of one made from orbit (1 m in position, 3 % in diameter,
    one in ten craters missing, one in twenty false).
    """
    ids = tuple(trajectory.split("/"))
    if len(ids) != 2:
        raise UserError("--trajectory", "trajectory", trajectory, "scene_id/trajectory_id")
    if grade not in GRADES:
        raise UserError("--grade", "grade", grade, "one of " + ", ".join(GRADES))
    offset = (position_m, velocity_mps, attitude_deg)
    for name, value in zip(("--position-m", "--velocity-mps", "--attitude-deg"), offset, strict=True):
        if not 0 < value < 1e4:
            raise UserError(name, "deviation", value, "above 0, below 10000")
    # pyarrow and pandas take a second to load.
    from perilune_shared.dataset.manifest import open_single
    from perilune_train.navigate.fly.unpack import unpack_descent

    count = unpack_descent(open_single(dataset), (ids[0], ids[1]), out, grade, exact, offset, seed)
    names = "frames, camera.yaml, catalogue.parquet, imu.csv, ranges.csv, prior.yaml, truth.csv"
    say(f"{out}: {count} frames; {names}")
