"""`perilune-train detect`: its subcommands."""

import typer

from perilune_train.detect.compare_command import compare
from perilune_train.detect.evaluate_command import evaluate
from perilune_train.detect.export_command import export
from perilune_train.detect.predict_command import predict
from perilune_train.detect.train_command import train
from perilune_train.detect.weights_command import weights

app = typer.Typer(
    help="Crater detection: train, judge, find craters in images, export for flight.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
app.command("train")(train)
app.command("evaluate")(evaluate)
app.command("compare")(compare)
app.command("predict")(predict)
app.command("export")(export)
app.command("weights")(weights)
