"""Prose that claims effects by hand is found, and other prose is left alone."""

from __future__ import annotations

from pathlib import Path

import pytest

from memmlp.report.unbacked_claims import NEVER, WORDS, claims

ROOT = Path(__file__).parent.parent.parent
DOCS = ROOT / "docs" / "results"


@pytest.mark.parametrize(
    "sentence",
    [
        "Jitter is +1.47* here.",
        r"Jitter is +1.47\* here.",
        "MPJPE changes by 0.3 [0.1, 0.5] cm.",
        "The memory lowers the position error by 0.17 cm.",
        "The memory raises Jitter.",
        "The memory loses against a GRU.",
        "The effect is significant.",
        "Placing it {{ effect('t', 'a', 'stream', 'MPJPE') }} further back is better.",
        "| arm | MPJPE | the effect 0.2 holds |",
        "- first\n- *manual* weights improve MPJRE",
        "The memory lowers the position error.",
        "Its errors are lower than those of a GRU.",
        "The full model is better than a GRU.",
        "Both outperform a GRU.",
        "MPJPE is half of a GRU's.",
        "Its Jitter is below a GRU's, by improving on it.",
        "It is 3 % more accurate.",
    ],
)
def test_a_planted_claim_is_found(sentence: str):
    text = f"# Title\n\nThis is prose about 41 frames. {sentence}\n\nMore of it.\n"
    found = claims(text)
    assert len(found) == 1
    assert found[0].line == 3 + sentence.count("\n")


@pytest.mark.parametrize(
    "sentence",
    [
        "The arm has {{ effect('t', 'a', 'stream', 'MPJPE') }}.",
        "Table 4 is the better one.",
        "`3.0* better` is code, [and this](https://x.org/better*3) an address.",
        "<!-- 0.17 cm lower -->",
        "A folder of 3 runs. It is better to keep them.",
        "Frames [2, 4] are listed.",
        "**30** clips, *in* order.",
    ],
)
def test_what_claims_nothing_is_left_alone(sentence: str):
    assert claims(f"{sentence}\n") == []


def test_every_word_of_the_rule_is_found():
    for word in (*WORDS, *NEVER):
        assert len(claims(f"It {word} 0.3 cm.")) == 1


def test_words_of_a_claim_may_stand_on_two_lines():
    (found,) = claims("The full model is more\naccurate than a GRU.\n")
    assert found.reason == "'more accurate than'"


def test_prose_claims_nothing_by_hand():
    for path in (ROOT / "README.md", *(DOCS / "templates").glob("*.md")):
        assert claims(path.read_text(encoding="utf-8")) == [], path
