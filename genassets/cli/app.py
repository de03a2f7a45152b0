"""The `genassets` command: registers every command and turns errors into one message and an exit code.

Command files are imported here for their signatures, so they import torch, prefect, mlflow, pandas and such
inside their functions: importing this module takes less than a quarter of a second (tests/test_doctor.py).
"""

from __future__ import annotations

import os
import sys
import traceback
from typing import Annotated

# Before pydantic is first imported, here or in a process that a command starts: its search for plugins, of which there
# are none, reads the metadata of every installed package.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")

import typer

from genassets import __version__
from genassets.cli import dataset, store, weights
from genassets.cli.augment import augment
from genassets.cli.bench import bench
from genassets.cli.compare import compare
from genassets.cli.complete import complete
from genassets.cli.doctor import doctor
from genassets.cli.explain import explain
from genassets.cli.export import export
from genassets.cli.flow import flow
from genassets.cli.gc import gc
from genassets.cli.generate import generate
from genassets.cli.hard_cases import hard_cases
from genassets.cli.inspect import inspect
from genassets.cli.list import list_runs
from genassets.cli.plan import plan
from genassets.cli.report import report
from genassets.cli.resume import resume
from genassets.cli.retry import retry
from genassets.cli.run import run
from genassets.cli.schema import schema
from genassets.cli.size import size
from genassets.cli.speed_error import speed_error
from genassets.cli.status import status
from genassets.cli.table import table
from genassets.cli.ui import ui
from genassets.cli.verify import verify
from genassets.errors import EnvironmentProblem, GenAssetsError

app = typer.Typer(
    name="genassets",
    help="Driving logs to complete 3D actors, evaluated on held-out views.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"genassets {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and stop."),
    ] = False,
    show_traceback: Annotated[
        bool,
        typer.Option(
            "--traceback",
            envvar="GENASSETS_TRACEBACK",
            help="With an error, also print where in the code it arose.",
        ),
    ] = False,
) -> None:
    if show_traceback:
        os.environ["GENASSETS_TRACEBACK"] = "1"


app.command("run")(run)
app.command("plan")(plan)
app.command("flow")(flow)
app.command("status")(status)
app.command("explain")(explain)
app.command("resume")(resume)
app.command("retry")(retry)
app.command("compare")(compare)
app.command("report")(report)
app.command("ui")(ui)
app.command("export")(export)
app.command("table")(table)
app.command("list")(list_runs)
app.command("verify")(verify)
app.command("gc")(gc)
app.command("size")(size)
app.command("schema")(schema)
app.command("bench")(bench)
app.command("doctor")(doctor)
app.command("hard-cases")(hard_cases)
app.command("generate")(generate)
app.command("augment")(augment)
app.command("speed-error")(speed_error)
app.command("complete")(complete)
app.command("inspect")(inspect)
app.add_typer(dataset.app, name="dataset")
app.add_typer(store.app, name="store")
app.add_typer(weights.app, name="weights")


def main() -> None:
    """Run the `genassets` command and end the process with its exit code.

    A GenAssetsError ends as its message on standard error and its exit code; what the system refuses (a
    directory that cannot be made, a full disk) ends likewise, with 6; typer ends with 2 for a wrong command
    line and 130 for Ctrl-C.
    """
    try:
        app()
    except (GenAssetsError, OSError) as error:
        if os.environ.get("GENASSETS_TRACEBACK", "0") not in ("", "0"):
            traceback.print_exc()
        print(f"genassets: {error}", file=sys.stderr)
        sys.exit(error.exit_code if isinstance(error, GenAssetsError) else EnvironmentProblem.exit_code)
