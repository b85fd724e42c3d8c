"""One use of every command of the three programs, in an order in which each finds what earlier ones wrote."""

from dataclasses import dataclass
from pathlib import Path

from tests.helpers.rendered import QUICK

PROGRAMS = ("perilune-manifest", "perilune-render", "perilune-train")

POSES = "# frame: O_L\ntime_s,x_m,y_m,z_m,qw,qx,qy,qz\n0,0,0,500,0,1,0,0\n1,0,0,480,0,1,0,0\n"


@dataclass(frozen=True)
class Use:
    """A command line."""

    command: str
    """Program and command, as in `tests/test_command_lines.py`."""
    arguments: tuple[str, ...] = ()
    """What follows it; paths are relative to the folder of the test."""
    code: int = 0
    """Expected exit code; 2 where what is needed takes too long to make, so that the command only starts."""

    @property
    def words(self) -> list[str]:
        program, *command = self.command.split()
        return [program, *command, *self.arguments]


def use(command: str, text: str = "", *more: str, code: int = 0) -> Use:
    return Use(command, (*text.split(), *more), code)


_TINY = ("--preset", "tiny", "--name", "tiny", "--out", "runs")
_SCENE = (*QUICK, "--set=dataset.render.threads=1")
USES = (
    use("perilune-render config"),
    use("perilune-render plan", "--preset tiny --out plan", *QUICK),
    use("perilune-render dataset", "--preset tiny --workers 1 --out data", *QUICK, "--set=dataset.render.exr=true"),
    use("perilune-render status", "data"),
    use("perilune-render develop", "--dataset data/nav --out developed"),
    use("perilune-render regenerate", "--manifest data/detect --verify --sample 1"),
    use("perilune-render survey", "--manifest data/nav --out survey --pixel-m 3"),
    use("perilune-render counterfactual", "--manifest data/detect --out without --frames-per-trajectory 1"),
    use("perilune-render detectability", "--dataset data/detect --out detectability.parquet --frames-per-trajectory 1"),
    use("perilune-render frames", "--preset tiny --poses poses.csv --out frames", *_SCENE),
    use("perilune-render preview", "--preset tiny --out preview.png", *QUICK),
    use("perilune-render ground", "--preset tiny --out scene.glb", *QUICK),
    use(
        "perilune-render spice",
        "--kernels none.bsp --spacecraft LRO --camera-frame C --start 2026-03-01T12:00:00 --end 2026-03-01T13:00:00 "
        "--out spice.csv",
        code=2,
    ),
    use("perilune-render serve", "--preset tiny --port 0 --native-port 0", *_SCENE, code=130),
    use("perilune-manifest validate", "data/detect"),
    use("perilune-manifest stats", "data/detect"),
    use("perilune-manifest subset", "data/detect --out subset --images none"),
    use("perilune-manifest merge", "data/detect --out merged", code=2),
    use("perilune-manifest split", "data/detect --out split --by trajectory"),
    use("perilune-manifest diff", "data/detect data/detect"),
    use("perilune-manifest migrate", "data/detect --out migrated", code=2),
    use("perilune-manifest pack", "data/detect --out packed"),
    use("perilune-manifest unpack", "packed --out unpacked"),
    use("perilune-manifest attach", "subset --frames data/detect --out attached"),
    use("perilune-manifest export", "data/detect --format coco --out coco"),
    use("perilune-manifest export", "data/detect --format huggingface --out huggingface"),
    use("perilune-manifest card", "data/detect"),
    use("perilune-train config"),
    use("perilune-train models"),
    use("perilune-train detect train", "--dataset drawn/detect", *_TINY),
    use("perilune-train detect calibrate", "--dataset drawn/detect --run runs/detect/tiny", code=2),
    use("perilune-train detect evaluate", "--dataset drawn/detect --run runs/detect/tiny --out evaluated"),
    use("perilune-train detect predict", "preview.png --out predicted"),
    use(
        "perilune-train detect deploy",
        "--out exported --run runs/detect/tiny --size-px 96 --dataset drawn/detect --int8",
    ),
    use("perilune-train detect compare", "runs/detect/tiny --out compared"),
    use("perilune-train detect weights", "runs/detect/tiny/checkpoints/best.ckpt --out network.weights", code=2),
    use("perilune-train detect benchmark", "--data nowhere", code=2),
    use("perilune-train navigate train", "--dataset drawn/nav", *_TINY),
    use("perilune-train navigate evaluate", "--dataset drawn/nav --run runs/navigate/tiny"),
    use("perilune-train navigate calibrate", "--dataset drawn/nav --run runs/navigate/tiny"),
    use("perilune-train navigate compare", "runs/navigate/tiny --out nav-compared"),
    use("perilune-train navigate deploy", "--out nav-exported --run runs/navigate/tiny"),
    use("perilune-train navigate map", "--dataset survey --out map"),
    use("perilune-train navigate methods", "--dataset data/nav --out methods"),
    use("perilune-train navigate monte-carlo", "--dataset data/nav --draws 1 --out monte-carlo"),
    use("perilune-train navigate descent", "--dataset data/nav --trajectory scene-0000/trajectory-0000 --out descent"),
    use(
        "perilune-train navigate fly",
        "--frames descent/frames --camera descent/camera.yaml --catalogue descent/catalogue.parquet --imu "
        "descent/imu.csv --prior descent/prior.yaml --out flight",
    ),
    use("perilune-train navigate trace", "--descent descent --out trace"),
    use("perilune-train navigate check-trace", "trace trace"),
    use("perilune-train navigate benchmark", "--data nowhere", code=2),
    use("perilune-train navigate benchmark-landing", "--data nowhere", code=2),
    use("perilune-train explain", "--dataset drawn", *_TINY),
    use("perilune-train causal", "--dataset data/detect --counterfactual without --turned without", *_TINY),
    use("perilune-train paper", "--runs runs"),
    use("perilune-train report", "--name tiny --dataset drawn --runs runs --out report --answers 1"),
)


def make_inputs(folder: Path) -> None:
    """Write what no command writes: drawn datasets, poses."""
    from tests.helpers.drawn_dataset import build_dataset

    build_dataset(folder / "drawn" / "detect", "detect", n_frames=2)
    build_dataset(folder / "drawn" / "nav", "nav", splits={"train": 2, "val": 1, "test": 1}, scenes=1)
    (folder / "poses.csv").write_text(POSES)
