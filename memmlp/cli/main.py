"""The command `memmlp`. A sub-command is imported only when it is called, so that --help is quick."""

import errno
import importlib
import os
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import NamedTuple

import click

import memmlp
from memmlp.common import distributed
from memmlp.common.errors import InputError, LeaseLost, RunStopped, TrainingDiverged, is_interruption, suggest
from memmlp.common.processes import collect_garbage_rarely, treat_termination_as_interrupt
from memmlp.common.progress import print_announcements
from memmlp.common.text_formats import print_in_any_encoding


class Command(NamedTuple):
    """A sub-command: the place of its implementation, its help line, and whether it can be resumed."""

    module: str
    attribute: str
    help: str
    resumes: bool = False


COMMANDS = {
    "demo": Command("demo", "demo", "Show a network on a real recording, then run a small ablation.", True),
    "train": Command("train", "command", "Train, evaluate, export and time one configuration (Hydra).", True),
    "data": Command("data", "data", "Make, import, prepare, inspect and export motion data."),
    "sweep": Command("sweep", "sweep", "Run the missing runs of a table or of your own sweep.", True),
    "tune": Command("tune", "tune", "Search loss weights, or other keys, by the validation errors.", True),
    "table": Command("table", "table", "Show the paper's tables beside measured numbers."),
    "results": Command("results", "results", "Keep results of runs in small files; show their tables."),
    "report": Command("ui", "report", "Write the page of `memmlp ui` as one HTML file."),
    "runs": Command("runs", "runs", "List, show, compare, tag, clean up and move runs."),
    "loggers": Command("loggers", "loggers", "Add runs to MLflow, TensorBoard or W&B."),
    "ui": Command("ui", "ui", "Show runs, sweeps and searches on a local web page, live."),
    "eval": Command("evaluate", "evaluate", "Show metrics and write predictions of a finished run."),
    "import-weights": Command("evaluate", "import_weights", "Make a run from weights that authors publish."),
    "predict": Command("predict", "predict", "Write a network's predictions for clips as BVH, glTF or npz."),
    "render": Command("render", "render", "Draw runs beside the ground truth as figures or films."),
    "live": Command("live", "live", "Show a network live on a local page, driven by a clip or trackers."),
    "models": Command("models", "models", "List the trained networks that the package ships."),
    "web": Command("web", "web", "Make a site that runs networks in any browser."),
    "export": Command("export", "export", "Write the ONNX file of a finished run."),
}


INTERRUPTED = 130  # exit code after a Ctrl-C


class CommandGroup(click.Group):
    """The commands, each imported only when it is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if (command := COMMANDS.get(cmd_name)) is None:
            return None
        return getattr(importlib.import_module(f"memmlp.cli.{command.module}"), command.attribute)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, command.help) for name, command in COMMANDS.items()])

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args[0] not in COMMANDS:
            hint = suggest(args[0], COMMANDS)
            raise InputError(f"{args[0]}: unknown command; {hint}use one of {', '.join(COMMANDS)}")
        return super().resolve_command(ctx, args)


@click.group(cls=CommandGroup, context_settings={"help_option_names": ["-h", "--help"], "show_default": True})
@click.version_option(memmlp.__version__, prog_name="memmlp")
def commands() -> None:
    """Mem-MLP: full-body motion from head and hands, and a platform for experiments with it.

    Runs and caches are stored in outputs/ in the current directory, or in MEMMLP_OUTPUTS.
    """


def main(argv: Sequence[str] | None = None) -> None:
    """Run a command line. Without `argv`, the command is the whole process; then SIGTERM acts like Ctrl-C.
    With MEMMLP_TRACEBACK=1 in the environment, errors are raised with their traceback."""
    is_process = argv is None
    print_in_any_encoding()
    if is_process:
        # By default torch's waiting threads spin, so a training on a busy machine takes five times longer.
        os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
        collect_garbage_rarely()
        if outputs := os.environ.get("MEMMLP_OUTPUTS"):
            os.environ["MEMMLP_OUTPUTS"] = os.path.expanduser(outputs)
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        with treat_termination_as_interrupt() if is_process else nullcontext():
            _run_command_line(arguments)
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        sys.exit(2)
    except Exception as error:
        code = _choose_exit_code(error)
        if code is None or os.environ.get("MEMMLP_TRACEBACK") == "1":
            raise
        line = _format_error(error if code != INTERRUPTED else click.Abort(), arguments)
        print(f"memmlp: {' '.join(line.split())}", file=sys.stderr)
        sys.exit(code)


def _run_command_line(arguments: list[str]) -> None:
    if distributed.world_size() > 1 and arguments[:1] != ["train"]:
        raise InputError("torchrun: only memmlp train can use several processes")
    if arguments[:1] in (["-sc"], ["--shell-completion"]):
        _print_completions(arguments)
    else:
        with print_announcements():
            commands.main(arguments, prog_name="memmlp", standalone_mode=False)


def _choose_exit_code(error: Exception) -> int | None:
    """Return the exit code for an expected error; None for a bug, which needs its traceback."""
    if isinstance(error, click.Abort) or is_interruption(error):  # click raises Abort for Ctrl-C
        return INTERRUPTED
    if isinstance(error, click.ClickException):
        return error.exit_code
    if isinstance(error, OSError) and error.strerror:
        return 2 if error.filename else 1  # 2 for a path from the user, 1 for a full or failing disk
    if type(error) in (InputError, TrainingDiverged, LeaseLost, RunStopped):
        return 2 if type(error) is InputError else 1
    return None


def _format_error(error: Exception, arguments: Sequence[str]) -> str:
    if isinstance(error, click.Abort):
        resumes = bool(arguments) and arguments[0] in COMMANDS and COMMANDS[arguments[0]].resumes
        return "interrupted" + "; repeat the command to continue from the last checkpoint" * resumes
    if isinstance(error, click.UsageError):
        path = error.ctx.command_path if error.ctx else "memmlp"
        return f"{error.format_message()} (see {path} --help)"
    if isinstance(error, OSError):
        reason = "no such file or folder" if error.errno == errno.ENOENT else error.strerror
        if error.errno == errno.ENOTDIR:
            above = Path(os.fsdecode(error.filename)).parents
            return f"{next(path for path in above if path.exists())}: must be a folder, not a file"
        return f"{error.filename or 'a file'}: {reason}"
    return error.format_message() if isinstance(error, click.ClickException) else str(error)


def _print_completions(arguments: list[str]) -> None:
    """Print shell completions: command names, or Hydra's completions after `memmlp train`.

    `memmlp train -sc install=bash` prints a script that calls `memmlp -sc query=bash` at every tab.
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
