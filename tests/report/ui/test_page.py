"""The page in a browser: filter, sort, curves, effects, a replay, news, and data that looks like markup."""

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from chromium import Browser
from report.ui.conftest import SEEDS, make_outputs, predict, run_of, started_run

from memmlp.cli.sweep import analyse
from memmlp.common.errors import InputError
from memmlp.report.tables.seed_rounds import start_rounds
from memmlp.report.ui.report_file import write_page
from memmlp.report.ui.server import Answers, RunsServer
from memmlp.runs.run import Run
from memmlp.sweep.plan import Plan

EVIL = "<img src=x onerror=owned=1>"
READY = "document.documentElement.dataset.ready !== undefined"
NAMES = "[...document.querySelectorAll('.runs tbody th a')].map(a => a.textContent)"


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep, a run that trains, one that is damaged, and one whose every word looks like markup."""
    outputs = tmp_path_factory.mktemp("home") / "outputs"
    make_outputs(outputs)
    tuned = started_run(outputs)
    name = " · ".join(f"loss.rotation_{which}=1.3385298778232695" for which in ("all", "root", "hands"))
    tuned.write_manifest({"name": f"{name} · seed 7"})
    damaged = outputs / "runs" / ("0" * 16)
    damaged.mkdir()
    (damaged / "manifest.json").write_text("{")
    evil = started_run(outputs, "e" * 16)
    evil.config_path.write_text(
        json.dumps({"memory": {"name": EVIL}, "seed": 9, EVIL: EVIL, "optim": {"steps": 900}})
    )
    (evil.folder / "notes.json").write_text(json.dumps({"tags": [EVIL], "note": EVIL}))
    evil.log(1000, {EVIL: 1.0})
    evil.fail(EVIL)
    return outputs


@pytest.fixture(scope="module")
def server(home: Path) -> Iterator[RunsServer]:
    with RunsServer(Answers(home, predict, 0.05), 0) as running:
        yield running


@pytest.fixture
def browser() -> Iterator[Browser]:
    with Browser() as running:
        yield running
        assert not running.errors


def go(browser: Browser, base: str, route: str, until: str) -> None:
    browser.open("about:blank")
    browser.open(f"{base}#/{route}")
    browser.wait(f"!!({READY} && ({until}))")


pytestmark = pytest.mark.slow


def test_filter_sort_compare_and_the_address(browser: Browser, server: RunsServer):
    go(browser, server.url, "runs", "document.querySelectorAll('.runs tbody tr').length >= 9")
    browser.value(
        "const f = document.querySelector('#filter'); f.value = 'memory=gru stream.MPJPE<99'; "
        "f.dispatchEvent(new Event('input'))"
    )
    names = [f"memory=gru · seed {seed}" for seed in SEEDS]
    assert sorted(browser.value(NAMES)) == names
    for order in (names, names[::-1]):
        browser.click(".runs thead th:nth-child(2) button")
        browser.wait(f"JSON.stringify({NAMES}) == JSON.stringify({json.dumps(order)})")
    assert browser.value("document.querySelector('th[aria-sort]').ariaSort") == "descending"
    heads = browser.value(
        "[...document.querySelectorAll('.runs thead button')].map(b => b.firstChild.textContent)"
    )
    assert "seed" in heads
    assert "memory" not in heads  # all of these have the same
    route = browser.value("location.hash")
    go(browser, server.url, route.removeprefix("#/"), f"{NAMES}.length == 3")
    assert browser.value(NAMES) == names[::-1]
    go(browser, server.url, "runs", "document.querySelectorAll('.runs tbody tr').length >= 9")
    edges = "[...document.querySelectorAll('.runs tbody .state')].map(s => s.getBoundingClientRect().right)"
    assert max(browser.value(edges)) < browser.value("innerWidth")
    go(browser, server.url, route.removeprefix("#/"), f"{NAMES}.length == 3")
    browser.click(".runs thead input")
    browser.wait("document.querySelector('button.primary').textContent == 'Compare 3'")
    browser.click("button.primary")
    browser.wait("document.querySelectorAll('.plot svg path').length >= 3")
    assert browser.value("document.querySelector('h1').textContent") == "3 runs"
    label = browser.value("document.querySelector('.plot svg').ariaLabel")
    assert label.startswith("training loss by step. memory=gru · seed")


def test_a_run_s_page_and_its_replay(browser: Browser, server: RunsServer, home: Path):
    run = run_of(home, "gru", 0)
    go(
        browser,
        server.url,
        f"run/{run.id}?clip=kicks%2F01",
        f"document.documentElement.dataset.replayed == '{run.id} 3'",
    )
    assert browser.value("[...document.querySelectorAll('.view-name span')].map(s => s.textContent)") == [
        "Truth", "memory=gru · seed 0", "memory=none · seed 0",
    ]  # fmt: skip
    pieces = browser.value("[...document.querySelectorAll('.pieces button')].map(b => b.textContent)")
    assert pieces[0] == "Worst second at 5.0 s: 20.0 cm"
    browser.value("document.querySelector('.transport .primary').click()")
    browser.wait("document.querySelector('.transport .primary').textContent == 'Play'")
    browser.value("document.querySelector('.pieces button').click()")
    browser.wait("Number(document.documentElement.dataset.shown) >= 300")
    assert "memory.name" in browser.value("document.querySelector('.config').textContent")
    assert "Its network: hardly trained (its steps saw 6.1" in browser.value(
        "document.querySelector('.warning').textContent"
    )


def test_a_sweep_s_effects_curves_and_rounds(browser: Browser, tmp_path: Path):
    sweep, folder = make_outputs(tmp_path), tmp_path / "sweeps" / "mine"
    with RunsServer(Answers(tmp_path, predict), 0) as running:
        go(browser, running.url, "sweep/mine", "document.querySelectorAll('.plot svg').length >= 2")
        label = browser.value("document.querySelector('.plot svg').ariaLabel")
        assert label.startswith("MPJPE [cm], differences from the control. gru: \N{MINUS SIGN}")
        assert ", holds; the paper: \N{MINUS SIGN}1.20" in label
        verdicts = "[...document.querySelectorAll('.verdict')].map(v => v.textContent)"
        assert browser.value(verdicts) == ["holds", "holds"]
    analyse(sweep, tmp_path, start_rounds(sweep), Plan.load(folder / "plan.json"))
    with RunsServer(Answers(tmp_path, predict), 0) as running:
        go(browser, running.url, "sweep/mine", "document.body.textContent.includes('Rounds')")
        words = browser.value("document.body.textContent")
        assert "2 of 2 comparisons are decided" in words
        assert "holdsat 3 seeds" in words
        rows = browser.value("[...document.querySelectorAll('.pair tbody tr')].map(r => r.textContent)")
        assert rows[0].startswith("3 seeds")
        assert "gru203\N{EN DASH}" in rows


def test_news_are_shown_without_a_touch(browser: Browser, server: RunsServer, home: Path):
    run = Run.from_id(home, "abcdef0123456789")
    go(browser, server.url, f"run/{run.id}", "document.querySelector('.plot svg')")
    data = "document.querySelector('.plot svg')?.ariaLabel"
    browser.wait(f"{data}?.includes('ends at 4.5')")
    browser.wait("document.querySelector('#status').textContent == 'live'")
    run.log(600, {"loss": 2.5})
    browser.wait(f"{data}?.includes('ends at 2.5')")


def test_data_is_never_markup_and_damage_is_shown(browser: Browser, server: RunsServer):
    for route in ("runs", f"run/{'e' * 16}", f"compare?runs={'e' * 16},abcdef0123456789"):
        go(browser, server.url, route, "document.body.textContent.includes('<img src=x')")
        assert browser.value("document.querySelectorAll('main img').length") == 0
        assert browser.value("typeof owned") == "undefined"
    go(browser, server.url, f"run/{'0' * 16}", "document.querySelector('.warning')")
    words = browser.value("document.querySelector('.warning').textContent")
    assert "manifest.json: cannot be read" in words


def test_a_file_without_a_server(browser: Browser, home: Path, tmp_path: Path):
    answers = Answers(home, predict)
    text = write_page(answers, ["mine.yaml"], "Generated today")
    with pytest.raises(InputError, match=r"other: must be a sweep in .*: mine"):
        write_page(answers, ["other"], "")
    assert EVIL not in text
    assert not re.search(r"<link[^>]*href=\"(?!data:)|<(script|img)[^>]*src=", text)
    file = tmp_path / "report.html"
    file.write_text(text)
    go(browser, file.as_uri(), "", "document.querySelectorAll('main h2').length >= 1")
    heads = "[...document.querySelectorAll('main h2')].map(one => one.textContent)"
    assert browser.value(heads) == ["Mine"]
    assert browser.value("document.body.textContent.includes('Generated today')")
    assert browser.value("document.querySelectorAll('.verdict').length") == 2
    go(browser, file.as_uri(), "runs", f"{NAMES}.length == 6")
    best = min(
        (run_of(home, "gru", seed) for seed in range(3)),
        key=lambda run: run.results["stream"]["rotation"]["MPJPE"],
    )
    go(browser, file.as_uri(), f"run/{best.id}", "document.documentElement.dataset.replayed?.endsWith(' 3')")
    go(browser, file.as_uri(), "sweep/mine", "document.querySelectorAll('.plot svg').length >= 2")


def test_daily_work_groups_baseline_csv_and_changes(browser: Browser, tmp_path: Path):
    make_outputs(tmp_path)
    new = started_run(tmp_path)
    gru, none = (run_of(tmp_path, variant, 0) for variant in ("gru", "none"))
    rows = "[...document.querySelectorAll('.runs tbody tr')].map(r => r.textContent)"
    with RunsServer(Answers(tmp_path, predict, 0.05), 0) as running:
        go(
            browser,
            running.url,
            f"runs?by=variant&base={none.id}",
            "document.querySelectorAll('.group').length == 3",
        )
        (group,) = (row for row in browser.value(rows) if "mine: gru" in row)
        assert "3 runs" in group
        assert re.search(r"5\.\d\d ± 0\.0\d\N{MINUS SIGN}1\.3", group)
        browser.value(
            "URL.createObjectURL = blob => { blob.text().then(t => { window.saved = t; }); return '#'; }; "
            "[...document.querySelectorAll('.tools button')].find(b => b.textContent == 'CSV').click()"
        )
        browser.wait("window.saved")
        head, *lines = browser.value("window.saved").splitlines()
        assert "stream.rotation.MPJPE" in head
        assert len(lines) == 7
        go(browser, running.url, f"run/{new.id}", "document.querySelector('.picked button')")
        press = "[...document.querySelectorAll('.picked button')].find(b => b.textContent == '{}').click()"
        browser.value(press.format("Stop"))
        browser.wait("document.querySelector('h1 + .state')?.textContent == 'stopped'")
        assert new.is_stop_requested
        browser.value(press.format("Retry"))
        browser.wait("document.querySelector('h1 + .state')?.textContent == 'interrupted'")
        browser.value(press.format("Name"))
        browser.value("document.querySelector('dialog input').value = 'Mine <b>'")
        browser.click("dialog .primary")
        browser.wait("document.querySelector('h1').textContent == 'Mine <b>'")
        browser.value(press.format("Delete"))
        browser.wait("document.querySelector('dialog')?.textContent.includes('Nothing depends')")
        browser.click("dialog .primary")
        browser.wait("location.hash == '#/runs'")
    assert not new.folder.exists()
    assert gru.folder.exists()


def test_what_runs_and_what_failed_is_on_top(browser: Browser, server: RunsServer, home: Path):
    with Run.from_id(home, "abcdef0123456789").lock():
        go(browser, server.url, "runs", "document.querySelector('.now progress')")
        text = browser.value("document.querySelector('.now').textContent")
        assert " failed" in text
        assert "training, step" in text
    browser.size(390, 844)
    go(browser, server.url, "runs?by=same", "document.querySelector('.group')")
    assert browser.value("document.documentElement.scrollWidth") <= 390
