"""Texts of users as data in other formats: shell, Hydra, URLs, keys, LaTeX, Markdown, CSV, terminals. A
reader of the format turns the result back into the given text."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import os
import re
import shlex
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

PLAIN_OVERRIDE = re.compile(r"(?!(?:true|false|null|inf|nan)$)[A-Za-z_/][A-Za-z0-9_/.+@-]*", re.IGNORECASE)
HOME = re.compile(
    r"""(['"])(?:\\.|(?!\1).)*\1|(?<=[=\[,])~(?=/|$|[\],])[^,\[\]'"]*""", re.DOTALL
)  # a quoted text, or a path below ~
UNUSUAL_NUMBER = re.compile(
    r"(?<==)[+-]?(?:0\d[\d_]*|\d+_[\d_]*\d)$"
)  # a key of a number accepts it as text, too
FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r", "'")

TEX_ESCAPES = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{",
    "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$", "\N{MINUS SIGN}": "$-$",
    "↓": r"$\downarrow$", "↑": r"$\uparrow$", "✓": r"$\checkmark$", "✗": r"$\times$",
    "‡": r"$\ddagger$", "²": r"\textsuperscript{2}", "³": r"\textsuperscript{3}", "<": r"$<$",
    ">": r"$>$", "|": r"\textbar{}", "`": r"\textasciigrave{}", '"': r"\textquotedbl{}",
}  # fmt: skip


def join_command(words: Iterable[str]) -> str:
    """Return a command's words as a line for bash; control characters become escapes such as $'\\x0a'."""
    return " ".join(map(_quote_word, words))


def _quote_word(word: str) -> str:
    if word.isprintable():
        simple = "'" in word and not set(word) & {*'"$`!\\'}
        return f'"{word}"' if simple else shlex.quote(word)
    plain = (letter if letter.isprintable() and letter not in "'\\" else None for letter in word)
    escaped = ("".join(f"\\x{byte:02x}" for byte in os.fsencode(letter)) for letter in word)
    return "$'" + "".join(one or other for one, other in zip(plain, escaped, strict=True)) + "'"


def make_override(key: str, text: str) -> str:
    """Return the override KEY=TEXT in Hydra's grammar; a text that is not a plain word is quoted."""
    if PLAIN_OVERRIDE.fullmatch(text):
        return f"{key}={text}"
    text = escape_interpolations(text)
    return f"{key}='" + re.sub(r"(\\*)('|\Z)", lambda m: m[1] * 2 + ("\\'" if m[2] else ""), text) + "'"


def escape_interpolations(value: Any) -> Any:
    """Return texts, or a config with texts, such that OmegaConf reads ${NAME} as it is written."""
    if isinstance(value, Mapping):
        return {key: escape_interpolations(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [escape_interpolations(item) for item in value]
    return re.sub(r"(\\*)\$\{", r"\1\1\\${", value) if isinstance(value, str) else value


def keep_text(override: str) -> str:
    """Return an override that Hydra does not change: with the home folder in place of ~ at the start of its
    value or of a list's item, and with quotes around a number whose digits are not plain, such as 010."""
    if number := UNUSUAL_NUMBER.search(override):
        return f"{override[: number.start()]}'{number[0]}'"
    return HOME.sub(lambda m: m[0] if m[1] else make_override("", os.path.expanduser(m[0]))[1:], override)


def make_sqlite_url(path: Path) -> str:
    """Return the SQLAlchemy URL of an absolute path of an SQLite file."""
    from urllib.parse import quote

    return f"sqlite:///{quote(str(path))}"


def make_key(text: str, allowed: str, max_length: int) -> str:
    """Return a key of another program for a text; texts that must be changed get different keys. `allowed` is
    the inside of a character class of a regular expression."""
    key = re.sub(rf"[^{allowed}]|(?<=\.)\.|(?<=/)/|(?<![^/])\.(?![^/])|^/|/$", "_", text)
    if key == text and len(key) <= max_length:
        return key
    return f"{key[: max_length - 9]}-{hashlib.sha256(text.encode(errors='surrogatepass')).hexdigest()[:8]}"


def escape_latex(text: str) -> str:
    """Return a text for LaTeX, also at the start of a table's row, where [ and * belong to the command
    before them. Ligatures are prevented. Line breaks become blanks."""
    text = re.sub(r"([-',!?])(?=[-'`,])", "\\1\0", " ".join(text.split()))
    escaped = "".join(TEX_ESCAPES.get(letter, letter) for letter in text).replace("\0", "{}")
    return f"{{}}{escaped}" if escaped.startswith(("[", "*", "(")) else escaped


def escape_markdown(text: str) -> str:
    """Escape all characters that Markdown would interpret. Line breaks become blanks."""
    return re.sub(r"([\\`*_|<>\[\]#~$&])", r"\\\1", " ".join(text.split()))


def format_csv(rows: Iterable[Sequence[Any]]) -> str:
    """Return rows as CSV. A text that a spreadsheet would run as a formula gets a ' in front."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(map(_guard, row) for row in rows)
    return text.getvalue()


def _guard(cell: Any) -> Any:
    return f"'{cell}" if isinstance(cell, str) and _is_formula(cell) else cell


def _is_formula(text: str) -> bool:
    with contextlib.suppress(ValueError):
        return float(text) is None
    return text.startswith(FORMULA_STARTS)


def parse_csv(text: str) -> list[dict[str, str]]:
    """Return the rows of `format_csv`, by the names in its first row."""
    rows = [[cell.removeprefix("'") for cell in row] for row in csv.reader(io.StringIO(text, newline=""))]
    return [dict(zip(rows[0], row, strict=True)) for row in rows[1:]]


def make_console(**options: Any) -> Console:
    """Return a console that prints texts as they are, without markup and emoji names."""
    from rich.console import Console

    return Console(highlight=False, markup=False, emoji=False, **options)


def print_in_any_encoding() -> None:
    """Make standard output and error print escapes for characters that their encoding does not have."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
