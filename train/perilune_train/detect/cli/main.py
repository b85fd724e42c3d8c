"""`perilune-train detect`: its subcommands."""

import typer

from perilune_train.detect.cli.benchmark import benchmark
from perilune_train.detect.cli.compare import compare
from perilune_train.detect.cli.evaluate import evaluate
from perilune_train.detect.cli.export import export
from perilune_train.detect.cli.predict import predict
from perilune_train.detect.cli.train import train
from perilune_train.detect.cli.weights import weights

app = typer.Typer(
    help="Crater detection: train, evaluate, find craters in images, export for flight.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
app.command("train")(train)
app.command("evaluate")(evaluate)
app.command("benchmark")(benchmark)
app.command("compare")(compare)
app.command("predict")(predict)
app.command("export")(export)
app.command("weights")(weights)
