"""The program: its commands, and what becomes of an error.

Each command is a file with a function whose parameters are its options, and `EPILOG`, the text below its help. Heavy
packages are imported inside the function, so that `--help`, `list` and tab completion answer at once.
"""

from __future__ import annotations

import errno
import logging
import os
import sys
import warnings
from collections.abc import Callable
from typing import Annotated, Literal

import typer

import latticebench
from latticebench.bench.cli import (
    compare,
    data,
    demo,
    diagnose,
    figures,
    fit,
    inspect,
    limit,
    listing,
    merge,
    plot,
    publish,
    run,
    schema,
    simulate,
    status,
    table,
)
from latticebench.bench.cli.streams import disarm, lead_nowhere, settle
from latticebench.bench.threads import prefer_one_thread
from latticebench.systems.errors import InputError, printable
from latticebench.systems.files import LARGEST

# Characters of a refusal.
LONGEST = 2000

app = typer.Typer(
    name="latticebench",
    help="Find the equations of motion of nonlinear lattices from data, and measure how well each method does it.",
    epilog="Start with:  latticebench run tiny    or    latticebench list systems",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
)


def _version(asked: bool) -> None:
    if asked:
        print(f"latticebench {latticebench.__version__}")
        raise typer.Exit


@app.callback()
def program(
    version: Annotated[  # noqa: ARG001
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
    largest_file: Annotated[
        int | None,
        typer.Option(
            min=1, max=10**8, metavar="MIB", help="Read files up to this size; 512 of data, 16 of texts if not given."
        ),
    ] = None,
    log: Annotated[
        Literal["debug", "info", "warning"] | None,
        typer.Option(metavar="LEVEL", help="Tell on standard error what is done: debug, info or warning."),
    ] = None,
) -> None:
    """Find the equations of motion of nonlinear lattices from data, and measure how well each method does it."""
    try:
        os.getcwd()
    except OSError as error:
        raise InputError(f"the working folder cannot be used: {error.strerror}; change to one that exists") from None
    if largest_file is not None:
        # The environment, since worker processes read files, too.
        os.environ[LARGEST] = str(largest_file)
    if log is not None:
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        logging.getLogger("latticebench").addHandler(handler)
        logging.getLogger("latticebench").setLevel(log.upper())


app.command("list", epilog=listing.EPILOG)(listing.list_)
app.command(epilog=simulate.EPILOG)(simulate.simulate)
app.command(epilog=inspect.EPILOG)(inspect.inspect)
app.command(epilog=fit.EPILOG)(fit.fit)
app.command(epilog=diagnose.EPILOG)(diagnose.diagnose)
app.command(epilog=demo.EPILOG)(demo.demo)
app.add_typer(data.app, name="data")
app.command(epilog=run.EPILOG)(run.run)
app.command(epilog=status.EPILOG)(status.status)
app.command(epilog=merge.EPILOG)(merge.merge)
app.command(epilog=table.EPILOG)(table.table)
app.command(epilog=figures.EPILOG)(figures.figures)
app.command(epilog=publish.EPILOG)(publish.publish)
app.command(epilog=compare.EPILOG)(compare.compare)
app.command(epilog=limit.EPILOG)(limit.limit)
app.command(epilog=plot.EPILOG)(plot.plot)
app.command(epilog=schema.EPILOG)(schema.schema)


def main() -> None:
    """Run the command line; bad input is one line on standard error and exit code 2."""
    settle()
    disarm()
    prefer_one_thread()
    # What libraries remark on the way is no help to anybody; who looks for it has said so with -W.
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
    try:
        code = app(standalone_mode=False)
        sys.stdout.flush()
    except InputError as error:
        _complain(str(error))
        code = 2
    except typer.Abort:
        code = 130
    except KeyboardInterrupt:
        code = 130
    except BrokenPipeError:
        # The reader (head, a pager) has seen enough; Python would complain once more on exit.
        lead_nowhere()
        code = 0
    except OSError as error:
        # Files of the user's are read and written with errors of their own; what is left is standard output.
        if error.errno not in (errno.ENOSPC, errno.EIO, errno.EDQUOT, errno.EFBIG):
            raise
        lead_nowhere()
        _complain(f"standard output cannot be written: {error.strerror}")
        code = 2
    except Exception as error:
        # Usage errors of the command-line library; anything else is a fault of ours and keeps its traceback.
        message: Callable[[], str] | None = getattr(error, "format_message", None)
        if message is None:
            raise
        text = message().strip().splitlines()
        if text:
            command = getattr(getattr(error, "ctx", None), "command_path", app.info.name)
            _complain(f"{' '.join(text)} (see: {command} --help)")
        code = 2
    sys.exit(code if isinstance(code, int) else 0)


def _complain(text: str) -> None:
    line = printable(" ".join(text.splitlines()))
    # What is wrong is said first, and what to do last; between them a name of any length may have been repeated.
    if len(line) > LONGEST:
        line = f"{line[: LONGEST // 2]} ... {line[-LONGEST // 2 :]}"
    print(f"error: {line}", file=sys.stderr)
