"""The `memmlp` command: sub-commands imported when they are called, errors in one line."""

from __future__ import annotations

import importlib
import os
import sys
from typing import NamedTuple

import click

import memmlp
from memmlp.errors import InputError, TrainingDiverged


class Command(NamedTuple):
    """Where a sub-command is, and its line of help."""

    module: str
    attribute: str
    help: str


COMMANDS = {
    "demo": Command("demo", "demo", "The whole way on embedded data, in minutes."),
    "train": Command("train", "command", "Train, evaluate, export and time one configuration (Hydra)."),
    "data": Command("data", "data", "Make, import, prepare and inspect motion data."),
    "runs": Command("runs", "runs", "List, show and compare runs."),
    "eval": Command("evaluate", "evaluate", "Metrics and predictions of a finished run."),
    "export": Command("export", "export", "ONNX file of a finished run."),
    "bench": Command("bench", "bench", "Measure this machine: preparation, streaming."),
}


class LazyGroup(click.Group):
    """A group that knows its commands' names and imports one when it is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The names, in the order of use."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        """The command, imported now."""
        if name not in COMMANDS:
            return None
        command = COMMANDS[name]
        return getattr(importlib.import_module(f"memmlp.cli.{command.module}"), command.attribute)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The table of commands, without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, command.help) for name, command in COMMANDS.items()])


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(memmlp.__version__, prog_name="memmlp")
def cli() -> None:
    """Mem-MLP: full-body motion from head and hands, and the platform for its ablations.

    Works in the current directory: runs and caches lie in outputs/ (or MEMMLP_OUTPUTS).
    """


def main(argv: list[str] | None = None) -> None:
    """Run the command and exit: 0, 1 for a failed run, 2 for bad input, 130 when interrupted."""
    args = sys.argv[1:] if argv is None else argv
    if args[:1] == ["-sc"]:  # Hydra's shell completion calls the executable without the word `train`
        os.environ["COMP_LINE"] = os.environ.get("COMP_LINE", "").replace("memmlp train", "memmlp", 1)
        args = ["train", *args]
    try:
        cli.main(args, prog_name="memmlp", standalone_mode=False)
    except click.exceptions.Abort:
        _fail("interrupted", 130)
    except KeyboardInterrupt:
        _fail("interrupted; the same command goes on from the last checkpoint", 130)
    except click.ClickException as error:
        _fail(error.format_message().replace("\n", " "), error.exit_code)
    except (InputError, TrainingDiverged) as error:
        if os.environ.get("MEMMLP_TRACEBACK"):
            raise
        _fail(" ".join(str(error).split()), 2 if isinstance(error, InputError) else 1)


def _fail(line: str, code: int) -> None:
    """One line on stderr, and out."""
    print(f"memmlp: {line}", file=sys.stderr)
    sys.exit(code)
