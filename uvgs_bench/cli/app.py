"""The ``uvgs`` command: a table of commands, and the one place where errors become lines and exit codes.

To add a command: 1. write ``cli/<name>.py`` with a function or a ``typer.Typer``; 2. add one line to ``COMMANDS``.
Command files import heavy packages inside their functions, so that ``uvgs --help`` stays quick.
"""

from __future__ import annotations

import importlib
import inspect
import os
import re
import sys
from collections.abc import Sequence
from typing import Annotated

import typer

from uvgs_bench import __version__
from uvgs_bench.errors import ExitCode, UvgsError

# What shells show for a program that a closed pipe ended.
_SIGPIPE_CODE = 141

COMMANDS: dict[str, str] = {
    "demo": "uvgs_bench.cli.demo:demo",
    "init": "uvgs_bench.cli.init:init",
    "calibrate": "uvgs_bench.cli.calibrate:calibrate",
    "camera": "uvgs_bench.cli.camera:app",
    "beacon": "uvgs_bench.cli.beacon:app",
    "run": "uvgs_bench.cli.run:run",
    "bag": "uvgs_bench.cli.bag:app",
    "node": "uvgs_bench.cli.node:node",
    "tune": "uvgs_bench.cli.tune:tune",
    "gantry": "uvgs_bench.cli.gantry:app",
    "gantry-sweep": "uvgs_bench.cli.gantry_sweep:gantry_sweep",
    "register": "uvgs_bench.cli.register:register",
    "report": "uvgs_bench.cli.report:report",
    "compare": "uvgs_bench.cli.compare:compare",
    "benchmark": "uvgs_bench.cli.benchmark:app",
    "study": "uvgs_bench.cli.study:study",
    "plan": "uvgs_bench.cli.plan:plan",
    "follow": "uvgs_bench.cli.follow:follow",
    "fuse": "uvgs_bench.cli.fuse:fuse",
    "doctor": "uvgs_bench.cli.doctor:doctor",
}

# roslaunch and ros2 launch add arguments of their own.
CONTEXTS: dict[str, dict[str, bool]] = {"node": {"allow_extra_args": True, "ignore_unknown_options": True}}


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
            for part in command.registered_commands:
                part.help = _flowing(part.help or inspect.getdoc(part.callback))
            app.add_typer(command, name=name)
        else:
            help_text = _flowing(inspect.getdoc(command))
            app.command(name, help=help_text, context_settings=CONTEXTS.get(name))(command)
    return app


def _flowing(text: str | None) -> str | None:
    """Help whose lines end where sentences do: pages keep the breaks of later paragraphs, whatever their width."""
    return None if text is None else re.sub(r"(?<![.:;?!\n])\n(?!\n)", " ", text)


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
    raise SystemExit(_exit_code(list(sys.argv[1:] if arguments is None else arguments)))


def _exit_code(arguments: list[str]) -> int:
    # Not through typer's own main: it turns signals and broken pipes into codes of its own before they can be said.
    try:
        command = typer.main.get_command(build_app())
        with command.make_context("uvgs", arguments) as context:
            command.invoke(context)
        sys.stdout.flush()
    except typer.Exit as leaving:
        return _flushed(leaving.exit_code)
    except UvgsError as error:
        return _said(str(error), int(error.exit_code))
    except (KeyboardInterrupt, typer.Abort):
        sys.stderr.write("interrupted\n")
        return int(ExitCode.INTERRUPTED)
    except (BrokenPipeError, SystemExit):
        # SystemExit is how rich, printing a help page, reports a broken pipe; nothing else here raises it.
        return _unheard()
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _said(f"{where}{error.strerror or error}", int(ExitCode.INPUT))
    except Exception as error:
        complaint = getattr(error, "format_message", None)
        if complaint is None:
            raise
        # Empty when a group of commands stands alone: then its help page was printed already.
        text = complaint().rstrip(".")
        where = getattr(getattr(error, "ctx", None), "command_path", "uvgs")
        return _said(f"{text}; see {where} --help" if text else "", int(ExitCode.USAGE))
    return int(ExitCode.DONE)


def _flushed(code: int) -> int:
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        return _unheard()
    except OSError as error:
        return _said(f"standard output: {error.strerror or error}", int(ExitCode.INPUT))
    return code


def _said(text: str, code: int) -> int:
    if text:
        from uvgs_bench.cli.console import print_error

        print_error(text)
    try:
        sys.stdout.flush()
    except OSError:
        _unheard()
    return code


def _unheard() -> int:
    """The reader of a pipe has gone: say nothing more, and do not pretend that the result arrived."""
    # The interpreter must not try to write at exit what could not be written now.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return _SIGPIPE_CODE
