"""The page in a browser: filter, sort, curves, effects, a replay, news, and data that looks like markup."""

import json
import re
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import optuna
import pytest
from chromium import Browser
from fake_search import open_study, to_the_end
from report.ui.conftest import SEEDS, make_outputs, predict, run_of, started_run

from memmlp.cli.sweep import analyse
from memmlp.common.errors import InputError
from memmlp.common.files import write_json
from memmlp.report.tables.seed_rounds import start_rounds
from memmlp.report.ui.report_file import write_page
from memmlp.report.ui.server import Answers, RunsServer
from memmlp.runs.run import Run
from memmlp.sweep.plan import Plan

EVIL = "<img src=x onerror=owned=1>"
READY = "document.documentElement.dataset.ready !== undefined"
PRESS = "[...document.querySelectorAll('{} button')].find(b => b.textContent.trim() == '{}').click()"
TRAINING = "abcdef0123456789"
SAVED = """URL.createObjectURL = blob => {
  blob.arrayBuffer().then(all => { window.saved = new TextDecoder('latin1').decode(all); }); return '#'; }"""


def count(selector: str) -> str:
    return f"document.querySelectorAll({selector!r}).length"


def texts(selector: str) -> str:
    return f"[...document.querySelectorAll({selector!r})].map(one => one.textContent)"


def text(selector: str) -> str:
    return f"document.querySelector({selector!r}).textContent"


NAMES = texts(".runs tbody th a")
LABEL = "document.querySelector('.plot [role=img]')?.ariaLabel"


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep, a run that trains, one that is damaged, and one whose every word looks like markup."""
    outputs = tmp_path_factory.mktemp("home") / "outputs"
    make_outputs(outputs)
    tuned = started_run(outputs)
    name = " · ".join(f"loss.rotation_{which}=1.3385298778232695" for which in ("all", "root", "hands"))
    tuned.write_manifest({"name": f"{name} · seed 7", "python": "3.11.7"})
    tuned.log_path.write_text("data: 40 clips\nMem-MLP: 200 of 2000 steps, 4 min left\n")
    (tuned.folder / "code.patch").write_text("+    return 2 * x\n")
    tuned.log(500, {"CPU [cores]": 1.5, "memory [GB]": 0.75}, "system")
    damaged = outputs / "runs" / ("0" * 16)
    damaged.mkdir()
    (damaged / "manifest.json").write_text("{")
    evil = started_run(outputs, "e" * 16)
    config = {"memory": {"name": EVIL}, "seed": 9, EVIL: EVIL, "optim": {"steps": 900}}
    evil.config_path.write_text(json.dumps(config))
    (evil.folder / "notes.json").write_text(json.dumps({"tags": [EVIL], "note": EVIL}))
    evil.log(1000, {EVIL: 1.0})
    evil.log_path.write_text(EVIL)
    evil.fail(EVIL)
    folder = outputs / "tune" / "mine"
    folder.mkdir(parents=True)
    study = open_study(folder)
    write_json(folder / "search.json", asdict(study.search) | {"command_line": []})
    to_the_end(study, outputs)
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
    go(browser, server.url, "runs", f"{count('.runs tbody tr')} >= 9")
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
    heads = browser.value(texts(".runs thead button"))
    assert "seed" in heads
    assert "memory" not in heads  # all of these have the same
    route = browser.value("location.hash")
    go(browser, server.url, route.removeprefix("#/"), f"{NAMES}.length == 3")
    assert browser.value(NAMES) == names[::-1]
    go(browser, server.url, "runs", f"{count('.runs tbody tr')} >= 9")
    edges = "[...document.querySelectorAll('.runs tbody .state')].map(s => s.getBoundingClientRect().right)"
    assert max(browser.value(edges)) < browser.value("innerWidth")
    go(browser, server.url, route.removeprefix("#/"), f"{NAMES}.length == 3")
    browser.click(".runs thead input")
    browser.wait(f"{text('button.primary')} == 'Compare 3'")
    browser.click("button.primary")
    browser.wait(f"{count('.plot svg path')} >= 3")
    assert browser.value(text("h1")) == "3 runs"
    assert browser.value(LABEL).startswith("training loss by step. memory=gru · seed")


def test_two_runs_are_compared_in_each_key_that_differs(browser: Browser, server: RunsServer, home: Path):
    pair = f"{run_of(home, 'gru', 0).id},{run_of(home, 'none', 1).id}"
    go(browser, server.url, f"compare?runs={pair}", f"{NAMES}.length == 2")
    assert browser.value(texts(".runs thead button"))[2:4] == ["memory", "seed"]


def test_a_run_s_page_and_its_replay(browser: Browser, server: RunsServer, home: Path):
    run = run_of(home, "gru", 0)
    shown = f"document.documentElement.dataset.replayed == '{run.id} 3'"
    go(browser, server.url, f"run/{run.id}?clip=kicks%2F01", shown)
    names = ["Truth", "memory=gru · seed 0", "memory=none · seed 0"]
    assert browser.value(texts(".view-name span")) == names
    assert browser.value(texts(".pieces button"))[0] == "Worst second at 5.0 s: 20.0 cm"
    browser.value("document.querySelector('.transport .primary').click()")
    browser.wait(f"{text('.transport .primary')} == 'Play'")
    browser.value("document.querySelector('.pieces button').click()")
    browser.wait("Number(document.documentElement.dataset.shown) >= 300")
    assert "memory.name" in browser.value(text(".config"))
    assert "Its network: hardly trained (its steps saw 6.1" in browser.value(text(".warning"))


def test_a_sweep_s_effects_curves_and_rounds(browser: Browser, tmp_path: Path):
    sweep, folder = make_outputs(tmp_path), tmp_path / "sweeps" / "mine"
    with RunsServer(Answers(tmp_path, predict), 0) as running:
        go(browser, running.url, "sweep/mine", f"{count('.plot svg')} >= 2")
        label = browser.value(LABEL)
        assert label.startswith("MPJPE [cm], differences from the control. gru: \N{MINUS SIGN}")
        assert ", holds; the paper: \N{MINUS SIGN}1.20" in label
        assert browser.value(texts(".verdict")) == ["holds", "holds"]
        legend = "●significant after Holm\N{RIGHT SINGLE QUOTATION MARK}s correction"
        assert browser.value(text("figcaption")).startswith(legend)
    run_of(tmp_path, "gru", 1).marker.unlink()
    run_of(tmp_path, "gru", 2).marker.unlink()
    with RunsServer(Answers(tmp_path, predict), 0) as running:
        go(browser, running.url, "sweep/mine", f"{count('.plot svg')} >= 2")
        assert browser.value(text("figcaption")).startswith("\N{MULTIPLICATION SIGN}one seed: undecided")
        assert "memmlp sweep mine.yaml seed=0,1,2" in browser.value(text("details.again pre"))
    make_outputs(tmp_path)
    analyse(sweep, tmp_path, start_rounds(sweep), Plan.load(folder / "plan.json"))
    with RunsServer(Answers(tmp_path, predict), 0) as running:
        go(browser, running.url, "sweep/mine", "document.body.textContent.includes('Rounds')")
        words = browser.value("document.body.textContent")
        assert "2 of 2 comparisons are decided" in words
        assert "holdsat 3 seeds" in words
        rows = browser.value(texts(".pair tbody tr"))
        assert rows[0].startswith("3 seeds")
        assert "gru203\N{EN DASH}" in rows


def test_news_are_shown_without_a_touch(browser: Browser, server: RunsServer, home: Path):
    run = Run.from_id(home, TRAINING)
    curves = "train+loss|system+CPU+[cores]|system+memory+[GB]"
    go(browser, server.url, f"run/{run.id}?y={curves}", f"{count('.plot svg')} == 3")
    browser.wait(f"{LABEL}?.includes('ends at 4.5')")
    browser.wait(f"{text('#status')} == 'live'")
    words = browser.value("document.querySelector('main').textContent")
    for shown in ("system CPU [cores]", "200 of 2000 steps, 4 min left", "return 2 * x", "python3.11.7"):
        assert shown in words
    run.log(600, {"loss": 2.5})
    run.log_path.write_text("evaluation: measure\n")
    browser.wait(f"{LABEL}?.includes('ends at 2.5')")
    browser.wait(f"{text('pre.log')} == 'evaluation: measure\\n'")


def test_data_is_never_markup_and_damage_is_shown(browser: Browser, server: RunsServer):
    for route in ("runs?axes=yes", f"run/{'e' * 16}", f"compare?runs={'e' * 16},{TRAINING}"):
        go(browser, server.url, route, "document.body.textContent.includes('<img src=x')")
        assert browser.value("document.querySelectorAll('main img').length") == 0
        assert browser.value("typeof owned") == "undefined"
    go(browser, server.url, f"run/{'0' * 16}", "document.querySelector('.warning')")
    assert "manifest.json: cannot be read" in browser.value(text(".warning"))


def test_a_file_without_a_server(browser: Browser, home: Path, tmp_path: Path):
    answers = Answers(home, predict)
    content = write_page(answers, ["mine.yaml"], "Generated today")
    with pytest.raises(InputError, match=r"other: must be a sweep in .*: mine"):
        write_page(answers, ["other"], "")
    assert EVIL not in content
    assert not re.search(r"<link[^>]*href=\"(?!data:)|<(script|img)[^>]*src=", content)
    file = tmp_path / "report.html"
    file.write_text(content)
    go(browser, file.as_uri(), "", f"{count('main h2')} >= 1")
    assert browser.value(texts("main h2")) == ["Mine"]
    assert browser.value("document.body.textContent.includes('Generated today')")
    assert browser.value(count(".verdict")) == 2
    go(browser, file.as_uri(), "runs", f"{NAMES}.length == 6")
    best = min(
        (run_of(home, "gru", seed) for seed in range(3)),
        key=lambda run: run.results["stream"]["rotation"]["MPJPE"],
    )
    go(browser, file.as_uri(), f"run/{best.id}", "document.documentElement.dataset.replayed?.endsWith(' 3')")
    go(browser, file.as_uri(), "sweep/mine", f"{count('.plot svg')} >= 2")
    go(browser, file.as_uri(), "search/mine", f"{count('.plot svg')} >= 6")


def test_views_pins_scatter_axes_tags_notes_archive_and_commands(browser: Browser, tmp_path: Path):
    make_outputs(tmp_path)
    run = run_of(tmp_path)
    choose = (
        "(s => { s.value = '%s'; s.dispatchEvent(new Event('change')); })("
        "[...document.querySelectorAll('label')].find(l => l.textContent.startsWith('%s'))"
        ".querySelector('select'))"
    )
    fill = "document.querySelector('dialog input, dialog textarea').value = '{}'"
    with RunsServer(Answers(tmp_path, predict, 0.05, lambda run: "memmlp train x"), 0) as running:
        go(browser, running.url, "runs?filter=seed=0", f"{count('.runs tbody tr')} == 2")
        browser.value(choose % ("window.rotation.MPJPE", "Pin"))
        browser.value(choose % ("stream.rotation.MPJPE", "Scatter"))
        browser.wait(f"{LABEL}?.startsWith('stream MPJPE [cm] by ')")
        browser.value(PRESS.format(".tools", "Save view"))
        browser.value(fill.format("Ours"))
        browser.click("dialog .primary")
        browser.wait("document.querySelector('.tools').textContent.includes('Ours')")
        go(browser, running.url, "runs", f"{count('.runs tbody tr')} == 6")
        browser.value(choose % ("Ours", "View"))
        browser.wait(
            f"{count('.runs tbody tr')} == 2 && {texts('.runs thead button')}.includes('MPJPEwindow, cm')"
        )
        go(browser, running.url, f"run/{run.id}", f"{count('.plot svg')} >= 1")
        for axis, unit in (("time", "hours"), ("samples", "samples")):
            browser.value(choose % (axis, "Over"))
            browser.wait(f"document.querySelector('.curves [role=img]').ariaLabel.includes('by {unit}.')")
        for button, value, shown in (
            ("Tags", "good", ".tag"), ("Note", "look", ".remark"), ("Name", "Mine <b>", "h1"),
        ):  # fmt: skip
            browser.value(PRESS.format(".picked", button))
            browser.value(fill.format(value))
            browser.click("dialog .primary")
            browser.wait(f"document.querySelector('{shown}')?.textContent == '{value}'")
        browser.value(PRESS.format(".picked", "Command"))
        browser.wait("document.querySelector('dialog textarea')?.value == 'memmlp train x'")
        browser.value(PRESS.format("dialog", "Cancel"))
        browser.value(PRESS.format(".picked", "Archive"))
        browser.wait(f"{texts('.picked button')}.includes('Restore')")
        go(browser, running.url, "runs", f"{count('.runs tbody tr')} == 5")
        browser.click(".count a")
        browser.wait(f"{count('.runs tbody tr')} == 1")


def test_daily_work_groups_baseline_csv_and_changes(browser: Browser, tmp_path: Path):
    make_outputs(tmp_path)
    new = started_run(tmp_path)
    gru, none = (run_of(tmp_path, variant, 0) for variant in ("gru", "none"))
    with RunsServer(Answers(tmp_path, predict, 0.05), 0) as running:
        go(browser, running.url, f"runs?by=variant&sel={none.id}&axes=yes", f"{count('.group')} == 3")
        browser.value(PRESS.format(".picked", "Baseline"))
        browser.wait(f"location.hash.includes('base={none.id}')")
        (group,) = (row for row in browser.value(texts(".runs tbody tr")) if "mine: gru" in row)
        assert "3 runs" in group
        assert re.search(r"5\.\d\d ± 0\.0\d\N{MINUS SIGN}1\.3", group)
        assert browser.wait(LABEL).startswith("7 lines over ")
        browser.value(f"{SAVED}; {PRESS.format('.tools', 'CSV')}")
        head, *lines = browser.wait("window.saved").splitlines()
        assert "stream.rotation.MPJPE" in head
        assert len(lines) == 7
        for place in (".tools", ".chart"):
            browser.value(f"window.saved = ''; {PRESS.format(place, 'PNG')}")
            assert browser.wait("window.saved")[1:4] == "PNG"
        go(browser, running.url, f"run/{new.id}", "document.querySelector('.picked button')")
        state = "document.querySelector('h1 + .state')?.textContent"
        for button, word in (
            ("Prioritise", "interrupted, prioritised"), ("No priority", "interrupted"), ("Stop", "stopped"),
            ("Retry", "interrupted"),
        ):  # fmt: skip
            browser.value(PRESS.format(".picked", button))
            browser.wait(f"{state} == {word!r}")
            assert new.is_stop_requested == (button == "Stop")
        browser.value(PRESS.format(".picked", "Delete"))
        browser.wait("document.querySelector('dialog')?.textContent.includes('Nothing depends')")
        browser.click("dialog .primary")
        browser.wait("location.hash == '#/runs'")
    browser.errors[:] = [one for one in browser.errors if new.id not in one]  # it may ask for the run again
    assert not new.folder.exists()
    assert gru.folder.exists()


def test_a_search_has_history_slices_contour_axes_and_timeline(browser: Browser, server: RunsServer):
    go(browser, server.url, "search/mine?objective=MPJPE&x=loss.hand", f"{count('.plot svg')} >= 6")
    heads = ["History", "Slices", "Contour", "Parallel axes", "Timeline", "Trials"]
    assert [head for head in browser.value(texts("main h2")) if head in heads] == heads
    labels = browser.value("[...document.querySelectorAll('[role=img]')].map(one => one.ariaLabel)")
    assert "MPJPE by loss.hand and loss.rotation_all" in labels
    assert browser.value(count("[role=img] g[aria-label=contour] path")) > 3
    browser.value("document.querySelector('tbody th a').click()")
    browser.wait(f"{count('.trail a')} == 2")
    browser.value("document.querySelectorAll('.trail a')[1].click()")
    browser.wait(f"location.hash.startsWith('#/search/mine?trial=') && {count('tr.chosen')} == 1")


def test_importance_from_25_trials_and_a_pareto_front_open_a_run(browser: Browser, tmp_path: Path):
    (folder := tmp_path / "tune" / "mine").mkdir(parents=True)
    study, run = open_study(folder, objectives=["MPJPE", "Jitter"]), started_run(tmp_path)
    write_json(folder / "search.json", asdict(study.search))
    spaces = {key: optuna.distributions.FloatDistribution(0, 1) for key in ("loss.hand", "lr")}

    def add_trial(number: int) -> None:
        values = [number, 26 - number if number % 2 else 25]  # odd ones: the front, 13 its middle
        params = {"loss.hand": number / 25, "lr": number * 7 % 25 / 25}
        about = {"distributions": spaces, "user_attrs": {"runs": [run.id] if number == 13 else []}}
        study.study.add_trial(optuna.trial.create_trial(params=params, values=values, **about))

    for number in range(1, 25):  # 0 is waiting
        add_trial(number)
    shares = "[...document.querySelectorAll('h2')].find(h => h.textContent == 'Importance').parentElement"
    with RunsServer(Answers(tmp_path, predict, 0.05), 0) as running:
        go(browser, running.url, "search/mine", f"{count('.plot svg')} >= 6")
        assert "needs 25 complete trials; with 24" in browser.value(f"{shares}.textContent")
        add_trial(25)
        browser.wait(f"{shares}.querySelector('tr')?.textContent.startsWith('hand')")
        assert browser.value(LABEL).startswith("Jitter by MPJPE; the best are 25, 23, 21, ")
        browser.click(".plot svg")
        browser.wait(f"location.hash == '#/run/{run.id}' && {count('.trail a')} == 2")
        browser.value("document.querySelectorAll('.trail a')[1].click()")
        browser.wait(f"{texts('tr.chosen th')} == 'trial 13'")


def test_what_runs_and_what_failed_is_on_top(browser: Browser, server: RunsServer, home: Path):
    with Run.from_id(home, TRAINING).lock():
        go(browser, server.url, "runs", "document.querySelector('.now progress')")
        words = browser.value(text(".now"))
        assert " failed" in words
        assert "training, step" in words
    browser.size(390, 844)
    for route, until in (
        ("runs?by=same", ".group"),
        ("sweep/mine", ".plot svg"),
        ("search/mine", ".plot svg"),
    ):
        go(browser, server.url, route, count(until))
        assert browser.value("document.documentElement.scrollWidth") <= 390
