"""The errors that the command line turns into one line and an exit code."""

import difflib
import errno
import importlib
import unicodedata
from collections.abc import Iterable
from importlib.util import find_spec
from types import ModuleType

BREAKING = ("Cc", "Cs", "Zl", "Zp")  # Unicode's controls, surrogates, line and paragraph separators


def escape_line_breaks(text: str) -> str:
    r"""Return the text with line breaks and control characters escaped, such as \n."""
    return "".join(repr(c)[1:-1] if unicodedata.category(c) in BREAKING else c for c in text)


class InputError(ValueError):
    """Bad user input; the message names the file or key, the problem and the expected input. The command line
    prints it, in one line, and exits with code 2."""

    def __init__(self, message: str) -> None:
        super().__init__(escape_line_breaks(message))


def suggest(word: str, options: Iterable[str]) -> str:
    """Return "did you mean X? " for the option that is most similar to a word; empty without one."""
    near = difflib.get_close_matches(word, list(options), n=1)
    return f"did you mean {near[0]}? " if near else ""


def describe_read_error(error: Exception) -> str:
    """Return the reason why a text or YAML file could not be read, without the file's name."""
    if isinstance(error, OSError):
        return "no such file" if error.errno == errno.ENOENT else error.strerror or str(error)
    if (mark := getattr(error, "problem_mark", None)) is not None:
        return f"line {mark.line + 1}, column {mark.column + 1}: {getattr(error, 'problem', 'not YAML')}"
    return " ".join(str(error).replace('"<unicode string>"', "it").split())


def check_installed(package: str, extra: str, purpose: str) -> None:
    """Raise InputError if an optional package is not installed; see `import_optional`."""
    if find_spec(package) is None:
        raise InputError(f"{purpose}: needs {package}: pip install 'memmlp[{extra}]'")


def import_optional(module: str, extra: str, purpose: str) -> ModuleType:
    """Import and return a module of a package that the extra `extra` installs. `purpose` is the override,
    option or file that needs it. Raises InputError without the package."""
    check_installed(module.split(".")[0], extra, purpose)
    return importlib.import_module(module)


class TrainingDiverged(RuntimeError):
    """The loss became NaN or infinite. The message names the step, loss term and clips. The exit code is
    1."""


class RunStopped(Exception):
    """Somebody asked for the end of a run's work; its checkpoint is written. The exit code is 1."""


class LeaseLost(RuntimeError):
    """Another process took over this process' folder, because this process was frozen for too long. This
    process writes nothing more to the folder. The message is one line; the exit code is 1."""


def is_disk_error(error: BaseException) -> bool:
    """Return whether the disk is full or read-only; then the run itself did not fail."""
    return isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


def is_interruption(error: BaseException) -> bool:
    """Return whether an error is, or follows from, a Ctrl-C or SIGTERM. Libraries report an interrupted
    import or composition as their own failure."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        cause = cause.__cause__ or cause.__context__
    return cause is not None
