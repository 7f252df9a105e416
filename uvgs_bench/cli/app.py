"""The ``uvgs`` command: a table of commands, and the one place where errors become lines and exit codes.

To add a command: 1. write ``cli/<name>.py`` with a function or a ``typer.Typer``; 2. add one line to ``COMMANDS``.
Command files import heavy packages inside their functions, so that ``uvgs --help`` stays quick.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from typing import Annotated

import typer

from uvgs_bench import __version__
from uvgs_bench.errors import ExitCode, UvgsError

COMMANDS: dict[str, str] = {
    "demo": "uvgs_bench.cli.demo:demo",
    "init": "uvgs_bench.cli.init:init",
    "calibrate": "uvgs_bench.cli.calibrate:calibrate",
    "camera": "uvgs_bench.cli.camera:app",
    "beacon": "uvgs_bench.cli.beacon:app",
    "run": "uvgs_bench.cli.run:run",
    "gantry": "uvgs_bench.cli.gantry:app",
    "gantry-sweep": "uvgs_bench.cli.gantry_sweep:gantry_sweep",
    "register": "uvgs_bench.cli.register:register",
    "report": "uvgs_bench.cli.report:report",
    "benchmark": "uvgs_bench.cli.benchmark:app",
    "doctor": "uvgs_bench.cli.doctor:doctor",
}


def build_app() -> typer.Typer:
    """Assemble the command from the table."""
    app = typer.Typer(
        name="uvgs",
        help="Prove how accurate a uVGS-2 sensor is: calibrate, sweep the beacon with the gantry, report the errors.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode="rich",
        context_settings={"help_option_names": ["-h", "--help"]},
    )

    @app.callback()
    def root(
        version: Annotated[
            bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
        ] = False,
    ) -> None:
        pass

    for name, target in COMMANDS.items():
        module_name, attribute = target.split(":")
        command = getattr(importlib.import_module(module_name), attribute)
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name)
        else:
            app.command(name)(command)
    return app


def _print_version(wanted: bool) -> None:
    if wanted:
        sys.stdout.write(f"uvgs {__version__}\n")
        raise typer.Exit


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command and leave with its exit code.

    Args:
        arguments: Command-line arguments; those of the process when None.

    Raises:
        SystemExit: Always, with the exit code.
    """
    code: object = 0
    try:
        code = build_app()(args=list(arguments) if arguments is not None else None, standalone_mode=False)
    except UvgsError as error:
        from uvgs_bench.cli.console import print_error

        print_error(str(error))
        code = int(error.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        sys.stderr.write("interrupted\n")
        code = int(ExitCode.INTERRUPTED)
    except BrokenPipeError:
        # The reader of a pipe has gone; nothing more can be said, and the interpreter must not try at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    except Exception as error:
        show = getattr(error, "show", None)
        if show is None:
            raise
        show()
        code = getattr(error, "exit_code", int(ExitCode.USAGE))
    raise SystemExit(code if isinstance(code, int) else 0)
