"""Finds claims of effects in prose that were written by hand, which only computed text may make.

The rules apply to each sentence (cells of tables and items of lists are sentences, too), after code,
addresses and comments are removed from it. A placeholder counts as a number.

1. No number has a star or an interval: `1.47*`, `0.3 [0.1, 0.5]`.
2. No sentence has a word of comparison or of verdict (`WORDS`) beside a number or a metric, by its name
   or in words (`ERRORS`).
   References such as "Table 4" or "Eq. 5" are no numbers.
3. No sentence has one of the words `NEVER`, with or without a number.

Measured effects are written with a placeholder, which adds the verdict.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import NamedTuple

from memmlp.evaluation.metric_facts import UNITS

WORDS = (
    "lose", "loses", "raise", "raises", "raised", "lower", "lowers", "lowered", "higher", "better", "best",
    "worse", "worst", "smoother", "rougher", "improve", "improves", "improved", "reduces", "reduced",
    "increases", "increased", "increase", "reduce", "doubles", "halves", "help", "helps", "hurts", "gain",
    "gains", "holds", "opposite", "equivalent", "drop", "drops", "dropped", "fall", "falls", "fell", "rise",
    "rises", "rose", "grow", "grows", "grew", "cut", "cuts", "decrease", "decreases", "decreased", "smaller",
    "smallest", "larger", "largest", "greater", "greatest", "shrinks", "halved", "doubled", "improvement",
    "reduction", "brings", "losing", "lost", "raising", "lowering", "lowest", "highest", "improving",
    "improvements", "reducing", "reductions", "halving", "doubling", "tripled", "triples", "twice", "half",
    "increasing", "decreasing", "dropping", "falling", "fallen", "rising", "risen", "growing", "grown",
    "cutting", "shrink", "shrank", "shrunk", "shrinking", "gained", "gaining", "helped", "helping", "hurt",
    "hurting", "calmer", "calmest", "smoothest", "roughest", "steadier", "faster", "fastest", "slower",
    "slowest", "quicker", "quickest", "worsen", "worsens", "worsened", "degrade", "degrades", "degraded",
    "exceed", "exceeds", "exceeded", "superior", "inferior", "less", "fewer", "closer", "closest", "nearer",
    "nearest", "stronger", "weaker", "below", "above", "accurate", "wins", "won",
)  # fmt: skip
NEVER = (
    "significant", "significantly", "beat", "beats", "beaten", "beating", "lose against", "loses against",
    "wins against", "outperform", "outperforms", "outperformed", "outperforming", "surpass", "surpasses",
    *(f"{word} than" for word in (
        "better", "worse", "more accurate", "less accurate", "smoother", "rougher", "calmer", "steadier",
    )),
)  # fmt: skip
ERRORS = ("errors", "position error", "rotation error", "accuracy")  # metrics in words


def _any(words: Iterable[str]) -> re.Pattern[str]:
    """Return a pattern of any of the words, which may stand on two lines."""
    either = "|".join(r"\s+".join(map(re.escape, word.split())) for word in words)
    return re.compile(rf"(?<!\w)({either})(?!\w)", re.IGNORECASE)


CLAIM, REFUSED, METRIC = _any(WORDS), _any(NEVER), _any((*UNITS, *ERRORS))
INTERVAL = re.compile(r"\d\*?\s*\\?\[\s*[+\-\N{MINUS SIGN}]?\d[\d.]*,\s*[+\-\N{MINUS SIGN}]?\d[\d.]*\s*\\?\]")
STAR = re.compile(r"\d\]?\s?\\?\*(?!\*)")
NUMBER = re.compile(r"(?<![\w.])[+\-\N{MINUS SIGN}]?\d+([.,]\d+)*(?!\w)")
REFERENCE = re.compile(
    r"\b(tables?|eqs?\.|figs?\.|sec\.|commits?|python|seeds?)\s+[\w.]*\d[\w.]*", re.IGNORECASE
)
OUTSIDE = re.compile(r"```.*?```|`[^`\n]*`|\{%.*?%\}|\{#.*?#\}|<!--.*?-->|(?<=\])\([^)\s]*\)", re.DOTALL)
PLACEHOLDER = re.compile(r"\{\{.*?\}\}", re.DOTALL)
SENTENCE = re.compile(r"(?<=[.!?;])\s+|\n\s*\n|\n(?=\s*([-*]|\d+\.|#+|>)\s)|(?<!\\)\||\n(?=\s*\|)")


class UnbackedClaim(NamedTuple):
    """A sentence with a claim that is not allowed: its line, its words, and what is wrong with them."""

    line: int
    sentence: str
    reason: str


def claims(text: str) -> list[UnbackedClaim]:
    """Return the claims of a Markdown text or template."""
    bare = OUTSIDE.sub(_blank, PLACEHOLDER.sub(lambda found: f"0{_blank(found)[1:]}", text))
    found = []
    for start, sentence in _sentences(bare):
        reason = _reason(sentence)
        if reason:
            line = bare.count("\n", 0, start + len(sentence) - len(sentence.lstrip())) + 1
            found.append(UnbackedClaim(line, " ".join(sentence.split()), reason))
    return found


def _blank(found: re.Match[str]) -> str:
    """Return spaces of the match's length, with its line breaks kept."""
    return re.sub(r"[^\n]", " ", found[0])


def _sentences(text: str) -> list[tuple[int, str]]:
    """Return the sentences, each with the index where it begins."""
    ends = [(found.start(), found.end()) for found in SENTENCE.finditer(text)]
    starts = [0, *(end for _, end in ends)]
    stops = [*(start for start, _ in ends), len(text)]
    return [(start, text[start:stop]) for start, stop in zip(starts, stops, strict=True)]


def _reason(sentence: str) -> str | None:
    """Return what is wrong with a sentence; None if nothing is."""
    for pattern, what in ((STAR, "a number with a star"), (INTERVAL, "an interval")):
        if pattern.search(sentence):
            return what
    never = REFUSED.search(sentence)
    if never:
        return f"'{' '.join(never[0].split())}'"
    word, bare = CLAIM.search(sentence), REFERENCE.sub(" ", sentence)
    beside = NUMBER.search(bare) or METRIC.search(bare)
    return f"'{word[0]}' beside '{beside[0]}'" if word and beside else None
