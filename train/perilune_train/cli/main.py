"""`perilune-train`: train and evaluate the detector and the navigators, and compute their attention masks."""

from typing import Annotated

import typer

import perilune_train
from perilune_shared.config.page import annotated_yaml
from perilune_shared.config.resolve import Section, resolve, to_yaml
from perilune_shared.console.command_line import new_program, run_command_line
from perilune_shared.console.terminal import answer_page
from perilune_train.cli.detect import app as detect
from perilune_train.cli.explain import causal, explain
from perilune_train.cli.navigate import app as navigate
from perilune_train.cli.options import ConfigFile, Preset, Settings
from perilune_train.cli.report import paper, report
from perilune_train.detect.config import DetectConfig
from perilune_train.explain.config import ExplainConfig
from perilune_train.motion.config import NavigateConfig
from perilune_train.shipped.models import shipped_models

SECTIONS: dict[str, type[Section]] = {"detect": DetectConfig, "navigate": NavigateConfig, "explain": ExplainConfig}
app = new_program(
    "perilune-train",
    perilune_train.__version__,
    "Train networks for crater detection and landing navigation on perilune datasets; draw attention masks.",
)


app.add_typer(detect, name="detect")
app.add_typer(navigate, name="navigate")
app.command("explain")(explain)
app.command("causal")(causal)
app.command("paper")(paper)
app.command("report")(report)


@app.command()
def config(
    preset: Preset = "small",
    config: ConfigFile = None,
    settings: Settings = None,
    show: Annotated[
        bool,
        typer.Option(
            "--show/--plain", help="Print each setting with meaning, unit and default, or print the values only."
        ),
    ] = True,
) -> None:
    """Print all settings of detection, navigation and explanation as a configuration file to edit."""
    for section, model in SECTIONS.items():
        resolved = resolve(model, section, "perilune_train", preset, config, tuple(settings or ()))
        answer_page(annotated_yaml(section, resolved) if show else to_yaml(section, resolved))


@app.command()
def models() -> None:
    """List the installed networks with their size, their result on the locked benchmark and their folder.

    Pass the folder to --run. The file card.md in the folder states training data, results and limits.
    """
    for model in shipped_models():
        answer_page(f"{model.name}  {model.task}  {model.megabytes:.1f} MB  {model.headline}  {model.folder}")


def main() -> None:
    """Entry point of the command line."""
    run_command_line(app)


if __name__ == "__main__":
    main()
