"""Flags about the code behind a table: its recipes, files that differ, and what has changed since."""

from __future__ import annotations

import functools
import hashlib
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence

from memmlp.runs.environment import changed, code_digests
from memmlp.tables.flag_words import flags_of_difference, listed, quoted
from memmlp.tables.measured_run import Measured

FILES = 5  # names of files that a flag has at most


def recipes(every: Sequence[tuple[str, Measured]]) -> Iterable[str]:
    """Flag components that several variants use, but with different recipe versions."""
    versions = [(run.origin.every_recipe, label) for label, run in every]
    for name in sorted({name for known, _ in versions for name in known}):
        having = [(str(known[name]), label) for known, label in versions if name in known]
        yield from flags_of_difference(f"recipe of {name}", having)


def other_files(every: Sequence[tuple[str, Measured]]) -> Iterable[str]:
    """Flag files of memmlp whose code differs between variants, be it of one commit.

    Users' packages are left to `own_code`. Kept results have no digests of files, and are left out.
    """
    having = [(run.code, label) for label, run in every if run.code]
    digests: dict[str, set[str]] = defaultdict(set)
    for code, _ in having:
        for name in code:
            digests[name].add(code[name])
    names = sorted(name for name, found in digests.items() if len(found) > 1 and ":" not in name)

    def version(code: Mapping[str, str]) -> str:
        return hashlib.sha256(repr([code.get(name) for name in names]).encode()).hexdigest()[:7]

    yield from flags_of_difference(
        f"code of {listed(names, FILES)}", [(version(code), label) for code, label in having]
    )


def older_code(runs: Iterable[tuple[str, Mapping[str, str], Iterable[str]]]) -> Iterable[str]:
    """Flag runs that were made before code changed, though no recipe version was raised.

    Args:
        runs: for each run its variant's label, the digests of its code (`code_digests`; empty where these are
            not known), and the users' packages that it uses.
    """
    today = functools.cache(code_digests)
    found = [(label, changed(code, today(tuple(packages)))) for label, code, packages in runs if code]
    names = sorted({name for _, files in found for name in files})
    if names:
        labels = quoted(label for label, files in found if files)
        since = "has changed since these runs, under the same recipes"
        yield f"code of {listed(names, FILES)} {since}: {labels}"


def upstream_weights(every: Sequence[tuple[str, Measured]]) -> Iterable[str]:
    """Flag upstream runs with other weights under the same id: trained again, or on another machine."""
    found: dict[str, list[tuple[str, str]]] = defaultdict(list)
    for label, run in every:
        for upstream, digests in run.origin.upstream_weights.items():
            found[upstream] += [(digest, label) for digest in digests.split(", ")]
    for upstream, having in found.items():
        yield from flags_of_difference(f"digest of the weights of upstream run {upstream}", having)


def own_code(every: Sequence[tuple[str, Measured]]) -> Iterable[str]:
    """Flag users' packages of which variants use different versions or code."""
    for name in sorted({name for _, run in every for name in run.origin.plugins}):
        having = [(run.origin.plugins[name], label) for label, run in every if name in run.origin.plugins]
        yield from flags_of_difference(f"code of {name}", having)
