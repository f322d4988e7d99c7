"""Change random lines of the package, one at a time: do the tests of its folder fail?

    python benchmarks/mutants.py --count 20 --seed 0

Each mutant is tested in a copy of the checkout, by the test file that mirrors its module, then by its
folder's tests. Exits with 1 if a mutant survives: a test is missing, or the change makes no difference.
"""

import argparse
import ast
import functools
import itertools
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
import torch

ROOT = Path(__file__).resolve().parent.parent
TIMEOUT = 1800  # seconds; a mutant that makes the tests hang so long counts as killed
MARKERS = "not slow and not long", "slow and not long"
OTHER: dict[type, str] = {
    ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">", ast.Eq: "!=", ast.NotEq: "==",
    ast.In: "not in", ast.NotIn: "in", ast.Is: "is not", ast.IsNot: "is",
    ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*", ast.FloorDiv: "*", ast.Mod: "*",
    ast.Pow: "*", ast.MatMult: "*", ast.BitOr: "&", ast.BitAnd: "|", ast.And: "or", ast.Or: "and",
}  # fmt: skip
"""The operator that replaces each one in a mutant."""


class Mutant(NamedTuple):
    """A change of `file` (relative to the checkout) from byte `start` to `end` into `text`."""

    file: Path
    line: int
    start: int
    end: int
    text: str

    def __str__(self) -> str:
        before = (ROOT / self.file).read_bytes()[self.start : self.end].decode()
        return f"{self.file}:{self.line}: {' '.join(before.split())} -> {self.text}"

    def apply(self, root: Path) -> None:
        content = (ROOT / self.file).read_bytes()
        (root / self.file).write_bytes(content[: self.start] + self.text.encode() + content[self.end :])


def replacements(node: ast.AST) -> Iterator[tuple[ast.AST, str]]:
    match node:
        case ast.Compare(left, [op, *_], [right, *rest]) if not rest:
            yield node, f"{ast.unparse(left)} {OTHER[type(op)]} {ast.unparse(right)}"
        case ast.BinOp(left, op, right) if type(op) in OTHER:
            yield node, f"(({ast.unparse(left)}) {OTHER[type(op)]} ({ast.unparse(right)}))"
        case ast.BoolOp(op, values):
            yield node, f"({f' {OTHER[type(op)]} '.join(f'({ast.unparse(value)})' for value in values)})"
        case ast.UnaryOp(ast.Not() | ast.USub(), operand):
            yield node, f"({ast.unparse(operand)})"
        case ast.Constant(bool(value)):
            yield node, repr(not value)
        case ast.Constant(int(value) | float(value)):
            yield node, repr(value + 1)
        case ast.Return(ast.AST() as value) if ast.unparse(value) != "None":
            yield node, "return None"
        case ast.Expr(ast.Call()) | ast.AugAssign() | ast.Raise():
            yield node, "pass"
        case ast.If(test) | ast.IfExp(test):
            yield test, f"(not ({ast.unparse(test)}))"


def code(node: ast.AST) -> Iterator[ast.AST]:
    """The nodes that are executed: no annotations, imports for types, or parts of f-strings."""
    if isinstance(node, ast.JoinedStr) or (
        isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    ):
        return
    yield node
    for name, value in ast.iter_fields(node):
        if name not in ("annotation", "returns", "decorator_list"):
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    yield from code(child)


def mutants(file: Path) -> list[Mutant]:
    content = (ROOT / file).read_bytes()
    starts = [0]
    for line in content.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found = []
    for node in code(ast.parse(content)):
        for piece, text in replacements(node):
            start = starts[piece.lineno - 1] + piece.col_offset  # type: ignore[attr-defined]
            end = starts[piece.end_lineno - 1] + piece.end_col_offset  # type: ignore[attr-defined]
            found.append(Mutant(file, piece.lineno, start, end, text))  # type: ignore[attr-defined]
    return found


def draw(count: int, seed: int, skip: list[str]) -> list[Mutant]:
    """Random lines that have a mutant, and a random mutant of each."""
    files = sorted(path.relative_to(ROOT) for path in (ROOT / "memmlp").rglob("*.py"))
    files = [file for file in files if not any(file.is_relative_to(folder) for folder in skip)]
    lines: dict[tuple[Path, int], list[Mutant]] = {}
    for mutant in (mutant for file in files for mutant in mutants(file)):
        lines.setdefault((mutant.file, mutant.line), []).append(mutant)
    dice = random.Random(seed)
    return [dice.choice(lines[line]) for line in dice.sample(sorted(lines), count)]


def find_tests(file: Path) -> list[Path]:
    """The test file of a module or of its folder, then the tests of its folder and of the folders above."""
    place = Path("tests", *file.parts[1:])
    parts = (place, *place.parents)[:-2]
    candidates = [path for part in parts for path in (part.with_name(f"test_{part.stem}.py"), part)]
    return [path for path in candidates if (ROOT / path).exists()] or [Path("tests")]


def passes(root: Path, tests: Path, marker: str) -> bool:
    """Whether the tests pass, in a fork of this process, which has imported what takes long."""
    child = os.fork()
    if child == 0:
        os.setpgid(0, 0)
        os._exit(run_tests(root, tests, marker))
    end = time.monotonic() + TIMEOUT
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status) in (0, 5)
        time.sleep(0.1)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return False


passes_unchanged = functools.cache(passes)


def run_tests(root: Path, tests: Path, marker: str) -> int:
    """Run tests of a copy with its own code; return pytest's exit code."""
    os.chdir(root)
    os.environ |= {"PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1"}
    sys.path.insert(0, str(root))
    sys.dont_write_bytecode = True
    torch.set_num_threads(1)  # tests/conftest.py sets it in the environment, too late here
    silence = os.open(os.devnull, os.O_RDWR)
    for stream in range(3):
        os.dup2(silence, stream)
    return int(pytest.main(["-x", "-q", "-n", "0", "-p", "no:cacheprovider", "-m", marker, str(tests)]))


def find_killer(root: Path, mutant: Mutant) -> Path | None:
    """The tests that fail with a mutant, the quick ones first; None if it survives."""
    for tests, marker in itertools.product(find_tests(mutant.file), MARKERS):
        mutant.apply(root)
        try:
            survived = passes(root, tests, marker)
        finally:
            shutil.copy2(ROOT / mutant.file, root / mutant.file)
        if not survived:
            if not passes_unchanged(root, tests, marker):
                sys.exit(f"{tests}: fails without a mutant")
            return tests
    return None


def copy_checkout(folder: str) -> Path:
    names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
    root = Path(folder) / "copy"
    for name in names.decode().split("\0"):
        if name and (ROOT / name).is_file():
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, root / name)
    return root


def main() -> None:
    parser = argparse.ArgumentParser(description="Are random one-line mutants killed by their tests?")
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--skip", action="append", default=[], help="a folder or file of the package")
    parser.add_argument("--dry-run", action="store_true", help="draw, and run nothing")
    words = parser.parse_args()
    chosen = draw(words.count, words.seed, words.skip)
    with tempfile.TemporaryDirectory() as folder:
        root = copy_checkout(folder)
        survivors = 0
        for number, mutant in enumerate(chosen, 1):
            killer = None if words.dry_run else find_killer(root, mutant)
            verdict = f"killed by {killer}" if killer else "drawn" if words.dry_run else "survived"
            print(f"{number:3} {verdict}: {mutant}", flush=True)
            survivors += verdict == "survived"
    sys.exit(survivors > 0)


if __name__ == "__main__":
    main()
