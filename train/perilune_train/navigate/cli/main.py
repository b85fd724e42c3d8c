"""`perilune-train navigate`: its subcommands."""

import typer

from perilune_train.navigate.cli.benchmark import benchmark
from perilune_train.navigate.cli.benchmark_landing import benchmark_landing
from perilune_train.navigate.cli.calibrate import calibrate
from perilune_train.navigate.cli.compare import compare
from perilune_train.navigate.cli.evaluate import evaluate
from perilune_train.navigate.cli.export import export
from perilune_train.navigate.cli.fly import fly
from perilune_train.navigate.cli.map import make_map
from perilune_train.navigate.cli.methods import methods
from perilune_train.navigate.cli.monte_carlo import monte_carlo
from perilune_train.navigate.cli.train import train
from perilune_train.navigate.cli.unpack import unpack

app = typer.Typer(
    help="Landing navigation: train the networks, evaluate, compare and export runs, fly the filter over a descent.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
app.command("train")(train)
app.command("evaluate")(evaluate)
app.command("benchmark")(benchmark)
app.command("benchmark-landing")(benchmark_landing)
app.command("calibrate")(calibrate)
app.command("compare")(compare)
app.command("export")(export)
app.command("methods")(methods)
app.command("monte-carlo")(monte_carlo)
app.command("map")(make_map)
app.command("fly")(fly)
app.command("unpack")(unpack)
