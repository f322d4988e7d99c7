"""The command `memmlp`. A sub-command is imported only when it is called, so that --help is quick."""

from __future__ import annotations

import difflib
import errno
import importlib
import os
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from typing import NamedTuple

import click

import memmlp
from memmlp.common import distributed
from memmlp.common.errors import InputError, LeaseLost, TrainingDiverged
from memmlp.common.processes import collect_garbage_rarely, treat_termination_as_interrupt
from memmlp.common.progress import send_announcements_to


class Command(NamedTuple):
    """The place of a sub-command's implementation, its line in the help, and whether it can be resumed."""

    module: str
    attribute: str
    help: str
    resumes: bool = False


COMMANDS = {
    "demo": Command("demo", "demo", "The whole pipeline on synthetic data, in minutes.", True),
    "train": Command("train", "command", "Train, evaluate, export and time one configuration (Hydra).", True),
    "data": Command("data", "data", "Make, import, prepare, inspect and export motion data."),
    "sweep": Command("sweep", "sweep", "Run the missing runs of a table or of your own sweep.", True),
    "tune": Command("tune", "tune", "Search loss weights, or other keys, by the errors on validation.", True),
    "table": Command("table", "table", "The paper's tables beside measured numbers."),
    "results": Command("results", "results", "Keep runs' results with the code; make pages of them."),
    "report": Command("report", "report", "The page of `memmlp ui` as one HTML file."),
    "runs": Command("runs", "runs", "List, show, compare, tag, clean up and move runs."),
    "loggers": Command("loggers", "loggers", "Add runs to MLflow, TensorBoard or W&B."),
    "mlflow": Command("loggers", "mlflow", "MLflow's page of the runs."),
    "ui": Command("ui", "ui", "Runs, sweeps and searches on a page of this machine, live."),
    "eval": Command("evaluate", "evaluate", "Metrics and predictions of a finished run."),
    "predict": Command("predict", "predict", "A network's predictions for clips, as BVH, glTF or npz."),
    "render": Command("render", "render", "Figures and films of runs beside the truth, coloured by error."),
    "live": Command("live", "live", "A network live on a local page, fed by a clip or by trackers."),
    "web": Command("web", "web", "A site that times and plays networks in any browser, and on a headset."),
    "export": Command("export", "export", "ONNX file of a finished run."),
    "bench": Command("bench", "bench", "Measure speed on this machine."),
}


INTERRUPTED = 130  # exit code after a Ctrl-C


class Commands(click.Group):
    """A group of commands that imports each command only when it is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the commands' names in the order of COMMANDS."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import and return the command with that name; None for an unknown name."""
        if (command := COMMANDS.get(cmd_name)) is None:
            return None
        return getattr(importlib.import_module(f"memmlp.cli.{command.module}"), command.attribute)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the help lines of COMMANDS, without importing the commands."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, command.help) for name, command in COMMANDS.items()])

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command that the first argument names. Raises InputError, with a hint, if none fits."""
        if args[0] not in COMMANDS:
            near = difflib.get_close_matches(args[0], COMMANDS, n=1)
            hint = f"did you mean {near[0]}? " if near else ""
            raise InputError(f"{args[0]}: no such command; {hint}use one of {', '.join(COMMANDS)}")
        return super().resolve_command(ctx, args)


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(memmlp.__version__, prog_name="memmlp")
def commands() -> None:
    """Mem-MLP: full-body motion from head and hands, and the platform for its ablations.

    Works in the current directory: runs and caches lie in outputs/ (or MEMMLP_OUTPUTS).
    """


def main(argv: Sequence[str] | None = None) -> None:
    """Run a command line. Exits with 1 for a failed run, 2 for bad input, 130 after an interruption.

    If this is the whole process (no `argv`), it treats SIGTERM, a scheduler's request to end, like Ctrl-C.

    With MEMMLP_TRACEBACK=1 in the environment the error is raised, which shows where it came from.
    """
    own = argv is None
    if own:
        collect_garbage_rarely()
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        with treat_termination_as_interrupt() if own else nullcontext():
            _run(arguments)
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        sys.exit(2)
    except Exception as error:
        code = _exit_code(error)
        if code is None or os.environ.get("MEMMLP_TRACEBACK") == "1":
            raise
        line = _line(error if code != INTERRUPTED else click.Abort(), arguments)
        print(f"memmlp: {' '.join(line.split())}", file=sys.stderr)
        sys.exit(code)


def _run(arguments: list[str]) -> None:
    if distributed.world_size() > 1 and arguments[:1] != ["train"]:
        raise InputError("torchrun: only memmlp train can use several processes")
    if arguments[:1] in (["-sc"], ["--shell-completion"]):
        _complete(arguments)
    else:
        with send_announcements_to():
            commands.main(arguments, prog_name="memmlp", standalone_mode=False)


def _exit_code(error: Exception) -> int | None:
    """Return the exit code for an error that one line explains; None for a bug, which needs its traceback."""
    if isinstance(error, click.Abort):  # what click makes of Ctrl-C
        return INTERRUPTED
    if isinstance(error, click.ClickException):
        return error.exit_code
    if isinstance(error, OSError) and error.strerror:
        return 2 if error.filename else 1  # about a path that the user gave, or its disk
    if type(error) in (InputError, TrainingDiverged, LeaseLost):
        return 2 if type(error) is InputError else 1
    cause: BaseException | None = error  # an error after a Ctrl-C, such as one that cut an import short
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        cause = cause.__cause__ or cause.__context__
    return None if cause is None else INTERRUPTED


def _line(error: Exception, arguments: Sequence[str]) -> str:
    if isinstance(error, click.Abort):
        command = COMMANDS.get(arguments[0]) if arguments else None
        resumed = "; the same command goes on from the last checkpoint" if command and command.resumes else ""
        return f"interrupted{resumed}"
    if isinstance(error, click.UsageError):
        path = error.ctx.command_path if error.ctx else "memmlp"
        return f"{error.format_message()} (see {path} --help)"
    if isinstance(error, OSError):
        reason = "no such file or folder" if error.errno == errno.ENOENT else error.strerror
        return f"{error.filename or 'a file'}: {reason}"
    return error.format_message() if isinstance(error, click.ClickException) else str(error)


def _complete(arguments: list[str]) -> None:
    """Answer a shell that asks for completions.

    `memmlp train -sc install=bash` prints a script that calls `memmlp -sc query=bash` at every tab. This
    function completes the names of commands; after `memmlp train`, Hydra completes.
    """
    words = os.environ.get("COMP_LINE", "").split(" ")
    if len(words) <= 2:
        print(" ".join(name for name in COMMANDS if len(words) == 2 and name.startswith(words[1])))
    elif words[1] == "train":
        from memmlp.cli.train import train

        os.environ["COMP_LINE"] = " ".join([words[0], *words[2:]])
        train(arguments)


if __name__ == "__main__":
    main()
