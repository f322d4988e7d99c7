"""`memmlp results`: what it keeps, shows and refuses; and the pages made from it."""

import json
from pathlib import Path

import pytest
from conftest import Memmlp, one_line

from docs.results.make_pages import update
from memmlp.common.errors import InputError

PAGES = Path("docs/results")


def make_pages(check: bool = False) -> int:
    return update(PAGES, check)


def test_kept_results_become_pages(memmlp: Memmlp, planned: None, capsys: pytest.CaptureFixture):
    saved = "docs/results/data/table14.json: 4 runs\n"
    fill = "missing: every variant's seed 99; fill with: memmlp sweep 14 seed=0,99\n"
    assert memmlp("results", "save", "14", "seed=0").out == saved
    assert memmlp("results", "save", "14", "seed=0,99").out == saved + fill
    assert "table14.json: 12 runs" in memmlp("results", "save", "14").out
    assert one_line(memmlp("results", "save", "14", "seed=0"), "table14.json", "seed 1", "--name")
    templates = Path("docs/results/templates")
    templates.mkdir()
    (templates / "README.md").write_text('{{ claims(["table14"]) }}\n')
    capsys.readouterr()
    assert make_pages(check=True) == 1
    assert (make_pages(), make_pages(check=True)) == (0, 0)
    words = ("4 differ", "4 written", "0 differ")
    assert capsys.readouterr().out == "".join(f"docs/results: 4 files, {each}\n" for each in words)
    assert Path("docs/results/table14.md").read_text().count("| 3/3 |") == 4
    assert " inconclusive" in Path("docs/results/README.md").read_text()
    for path in (Path("docs/results/table14.md"), Path("docs/results/tables/table14.csv")):
        text = path.read_text()
        path.write_text(text.replace("inconclusive", "holds", 1))
        assert make_pages(check=True) == 1
        assert f"{path}: differs" in capsys.readouterr().err
        make_pages()
        assert path.read_text() == text


def test_kept_results_are_shown_without_a_run(memmlp: Memmlp, planned: None):
    memmlp("results", "save", "14")
    ran = memmlp("results", "show", "table14", "--together", "(salsa)")
    assert ran.code == 0
    assert "merged 4 groups of test clips into 3" in " ".join(ran.out.split())
    for words in (["results", "show", "table14"], ["table", "14"]):
        flagged = " ".join(memmlp(*words, "--weigh-groups").out.split())
        assert "each group of test clips has the same weight" in flagged
    kept = memmlp("results", "show", "table14").out
    assert "merged" not in kept
    assert kept.splitlines()[2:20] == memmlp("table", "14").out.splitlines()[2:20]


def test_one_kept_seed_of_three_is_no_finished_table(memmlp: Memmlp, planned: None):
    memmlp("results", "save", "14", "seed=1")
    make_pages()
    page = Path("docs/results/table14.md")
    assert (page.read_text().count("| 1/3 |"), page.read_text().count("| 1/1 |")) == (4, 0)
    assert "missing: every variant's seed 0, 2\n" in page.read_text()
    memmlp("results", "save", "14", "seed=0,1,2,3")
    make_pages()
    assert page.read_text().count("| 4/4 |") == 4


def test_kept_results_are_joined(memmlp: Memmlp, planned: None):
    memmlp("results", "save", "14", "seed=0", "--name", "one")
    memmlp("results", "save", "14", "seed=1,2", "--name", "two")
    assert "table14.json: 12 runs" in memmlp("results", "join", "one", "two", "--name", "table14").out
    saved = Path("docs/results/data/table14.json").read_bytes()
    memmlp("results", "save", "14")
    assert Path("docs/results/data/table14.json").read_bytes() == saved
    assert one_line(memmlp("results", "join", "one", "tow", "--name", "x"), "tow.json", "must be one of: one")
    flag = "each group of test clips has the same weight"
    for words in ((), ("--weigh-groups",)):
        memmlp("results", "join", "one", "two", "--name", "weighed", *words)
        assert (flag in " ".join(memmlp("results", "show", "weighed").out.split())) == bool(words)


def test_pages_without_data_go(memmlp: Memmlp, planned: None):
    memmlp("results", "save", "14", "--name", "small")
    make_pages()
    Path("docs/results/notes.md").write_text("by hand\n")
    Path("docs/results/data/small.json").unlink()
    assert make_pages(check=True) == 1
    make_pages()
    left = {str(path) for path in Path("docs/results").rglob("*.*")}
    assert left == {"docs/results/notes.md"}


def test_results_of_a_file_elsewhere_keep_its_path(memmlp: Memmlp, planned: None):
    Path("mine.yaml").write_text("variants: {a: [b=1], c: [b=2]}\nseeds: [0, 1]\n")
    memmlp("results", "save", "./mine.yaml", "x=/data/here")
    content = json.loads(Path("docs/results/data/mine.json").read_text())
    assert (content["sweep"], content["overrides"]) == ("./mine.yaml", ["x=.../here"])
    assert make_pages() == 0


@pytest.mark.parametrize(("arguments", "words"), [
    (["save", "99"], ("no such sweep",)),
    (["save", "10", "seed=7"], ("no finished run", "memmlp sweep 10 seed=7")),
    (["save", "14", "optim.lr=1"], ("table14.json", "memmlp sweep table14 optim.lr=1", "--name")),
    (["save", "14", "--out", "/proc/no"], ("/proc/no",)),
    (["join", "table14", "table14", "--name", "twice"], ("at least two different",)),
    (["show", "15"], ("data/15.json", "must be one of: table14")),
])  # fmt: skip
def test_bad_input_is_one_line(memmlp: Memmlp, planned: None, arguments: list[str], words: tuple[str, ...]):
    memmlp("results", "save", "14")
    assert one_line(memmlp("results", *arguments), *words)


def test_pages_need_a_folder_of_results(tmp_path: Path):
    with pytest.raises(InputError, match=r"data: no such folder; .*--out"):
        update(tmp_path, check=False)
