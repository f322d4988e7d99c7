"""Texts with all characters that the formats use, read back by each format's own reader."""

import io
import subprocess
import sys
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given, settings
from hypothesis import strategies as st
from markdown_it import MarkdownIt
from omegaconf import OmegaConf
from sqlalchemy import make_url

from benchmarks.nasty_names import PIECES
from memmlp.common import text_formats as formats
from memmlp.common.errors import InputError
from memmlp.config.compose import compose_config

texts = st.lists(st.sampled_from(PIECES), max_size=12).map("".join)
quickly = settings(max_examples=200, deadline=None, derandomize=True, database=None)


@quickly
@given(texts)
def test_hydra_reads_the_text_of_an_override(text: str):
    config = OmegaConf.create({"key": ""})
    override = OverridesParser.create().parse_override(formats.make_override("key", text))
    OmegaConf.update(config, "key", override.value())
    assert config.key == text


@settings(max_examples=3, deadline=None, derandomize=True, database=None)
@given(st.lists(texts, min_size=200, max_size=200))
def test_bash_reads_the_words_of_a_command(words: list[str]):
    command = "printf '%s\\0' " + formats.join_command(words)
    printed = subprocess.run(["bash", "-c", command], capture_output=True, check=True).stdout
    assert printed.decode().split("\0")[:-1] == words


@quickly
@given(st.lists(texts, min_size=2, max_size=2))
def test_csv_keeps_texts_and_has_no_formulas(cells: list[str]):
    text = formats.format_csv([["a", "b"], cells])
    assert formats.parse_csv(text) == [dict(zip("ab", cells, strict=True))]
    printed = [cell.strip('"') for cell in text.split("\n", 1)[1].split(",")]
    assert not printed[0].startswith(("=", "@", "\t"))


@quickly
@given(texts)
def test_markdown_shows_the_text(text: str):
    (token,) = MarkdownIt().disable("entity").parseInline(formats.escape_markdown(text))
    shown = "".join(child.content for child in token.children or ())
    assert shown.split() == text.split()


@pytest.mark.parametrize(
    ("text", "escaped"),
    [("[2]", "{}[2]"), ("*", "{}*"), ("(c)", "{}(c)"), ("a--b", "a-{}-b"), ("5 %\n_", r"5 \% \_")],
)
def test_latex(text: str, escaped: str):
    assert formats.escape_latex(text) == escaped


@quickly
@given(st.sets(texts, min_size=2, max_size=2))
def test_keys_of_different_texts_differ(pair: set[str]):
    keys = {formats.make_key(text, r"\w. :/-", 40) for text in pair}
    assert len(keys) == 2
    assert all(len(key) <= 40 and "//" not in key and ".." not in key for key in keys)


@quickly
@given(texts)
def test_sqlite_urls(text: str):
    path = Path(f"/home/{text}/mlflow.db")
    assert make_url(formats.make_sqlite_url(path)).database == str(path)


def test_home_in_overrides(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HOME", "/home/jörg")
    assert formats.keep_text("data.root=~/amass") == "data.root='/home/jörg/amass'"
    assert formats.keep_text("data.root=[~/a,/b]") == "data.root=['/home/jörg/a',/b]"
    plain = ["~key", "a=b~c", "a='b,~,c'", "a=['[~/b',c]"]
    assert [*map(formats.keep_text, plain)] == plain


@pytest.mark.parametrize("text", ["010", "1_000", "+05"])
def test_folders_that_look_like_numbers_keep_their_names(text: str):
    assert compose_config([f"save_predictions={text}"])["save_predictions"] == text
    assert compose_config([f"seed={text}"])["seed"] == int(text)


def test_a_wrong_type_names_the_limits():
    with pytest.raises(InputError, match=r"expected an integer, at least 1$"):
        compose_config(["optim.steps=1e3"])


def test_a_console_prints_texts_as_they_are(capsys: pytest.CaptureFixture[str]):
    formats.make_console(width=80).print("[red]:bug:[/red] [2]")
    assert capsys.readouterr().out == "[red]:bug:[/red] [2]\n"


def test_output_in_any_encoding(monkeypatch: pytest.MonkeyPatch):
    stream = io.TextIOWrapper(io.BytesIO(), "ascii")
    monkeypatch.setattr(sys, "stdout", stream)
    formats.print_in_any_encoding()
    print("5 ↓ \udc80", flush=True)
    assert stream.buffer.getvalue() == b"5 \\u2193 \\udc80\n"
