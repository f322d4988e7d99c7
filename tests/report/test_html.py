"""The report's page, as text and in a browser."""

from __future__ import annotations

import base64
import html
import math
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from chromium import Browser
from conftest import Memmlp, one_line
from fake_runs import CLIPS, fake_sweep, nothing, runs_of, table_of

from memmlp.common.errors import InputError
from memmlp.report import figures
from memmlp.report.html import Chapter, _accuracy, _points, _robust_words, page, published
from memmlp.runs.run import Run
from memmlp.sweep.definition import Sweep
from memmlp.sweep.plan import Entry, Plan
from memmlp.sweep.sweep_file import load_sweep
from memmlp.tables.build_table import make_table, without_runs
from memmlp.tables.error_distributions import Distribution, distributions
from memmlp.tables.table_text import caption

SHIPPED = Path(__file__).parent.parent.parent / "sweeps"
NAMES = ("table01", "table04", "table06", "table14", "table17")


def measured(outputs: Path, name: str) -> Chapter:
    """Make a chapter whose runs are all there."""
    sweep = load_sweep(SHIPPED / f"{name}.yaml")
    find = fake_sweep(outputs, sweep, {"2": 1.1, "no Multi-Head, no Memory-Block": 1.2}, log=True)
    return Chapter(sweep, table_of(sweep, find), runs_of(sweep, find))


@pytest.fixture(scope="module")
def chapters(tmp_path_factory: pytest.TempPathFactory) -> list[Chapter]:
    sweep = load_sweep(SHIPPED / "table01.yaml")
    table = without_runs(sweep, ("stream", "window"), "nothing measured: data.root")
    outputs = tmp_path_factory.mktemp("outputs")
    return [Chapter(sweep, table, runs_of(sweep, nothing)), *(measured(outputs, n) for n in NAMES[1:])]


@pytest.fixture(scope="module")
def text(chapters: list[Chapter]) -> str:
    systems = published(*(load_sweep(SHIPPED / f"table{number}.yaml") for number in ("01", "17")))
    return page(chapters, systems, "Generated today", "0123456")


def test_systems_of_both_tables():
    systems = published(*(load_sweep(SHIPPED / f"table{number}.yaml") for number in ("01", "17")))
    assert {(point.label, point.fps, point.error) for point in systems} == {
        ("AvatarPoser", 72.0, 3.08),
        ("AGRoL-MLP", 26.0, 2.69),
        ("AGRoL-Diffusion", 3.5, 2.66),
        ("Mem-MLP-41", 72.0, 2.57),
        ("Mem-MLP-60", 65.0, 2.56),
    }


@pytest.mark.slow
def test_page_needs_nothing_else(text: str):
    """The page loads nothing by address: no scripts, styles, images or fonts."""
    assert not re.search(r"<script|<link(?! rel=\"icon\" href=\"data:)|@import|url\((?!#)|src=|<img", text)
    addresses = set(re.findall(r"https?://[^\"'\s<)]+", text))
    assert addresses <= {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}


@pytest.mark.parametrize("count", [2, 12, 13])
def test_points_of_ours_are_named_where_they_are_few(count: int):
    """A point that two tables share is named once."""
    points = [figures.SpeedAndError(f"arm {number};", 100.0 + number, 4.0) for number in range(count)]
    svg = figures.accuracy(
        {"one": points, "other": points[:1]}, [figures.SpeedAndError("theirs", 72, 3)], "MPJRE"
    )
    assert svg.count("theirs") == 1
    assert [svg.count(point.label) for point in points] == [int(count <= 12)] * count


def test_a_figures_arms_are_named():
    """In the legend, for lines have no other names."""
    curve = figures.Curve([1, 2], [1.0, 0.5])
    svg = figures.curves("losses", {"loss": {"one arm": [curve], "other arm": [curve, curve]}})
    assert (svg.count("one arm"), svg.count("other arm")) == (1, 1)


@pytest.mark.slow
def test_page_has_every_table_and_figure(chapters: list[Chapter], text: str):
    for chapter in chapters:
        assert f'<section class="result" id="{chapter.sweep.name}">' in text
        assert (
            f'<a href="#{chapter.sweep.name}">{html.escape(caption(chapter.table), quote=True)}</a>' in text
        )
    assert (
        text.count("<figure>") == text.count("</svg>") == 3 + 3 + 1 + 4
    )  # effects, profiles, accuracy, training
    runs = {run.id for chapter in chapters for found in chapter.runs.values() for run in found.values()}
    assert len(runs) == 15 + 9 + 12 + 5
    for run in runs:
        assert text.count(f"<code>{run}</code>") == 2  # latency and runs
    assert "Generated today, code 0123456, 41 finished runs stand in these tables" in text
    assert "nothing measured: data.root" in text


@pytest.mark.slow
def test_ids_are_unique_and_links_lead_somewhere(text: str):
    ids = re.findall(r' id="([^"]+)"', text)
    of_page = [name for name in ids if not re.fullmatch(r"[mp][0-9a-f]{10}", name)]
    assert len(set(of_page)) == len(of_page)
    assert set(re.findall(r'<a href="#([^"]+)"', text)) <= set(of_page)


@pytest.mark.slow
def test_distributions_by_hand(tmp_path: Path):
    """Interquartile means, probabilities of improvement and profile of a metric are as computed here."""
    sweep = load_sweep(SHIPPED / "table14.yaml")
    find = fake_sweep(tmp_path, sweep, {"2": 1.02})
    found = {one.label: one for one in distributions(sweep, runs_of(sweep, find), "stream")["MPJPE"]}
    ours, theirs = found["2"], found["2, 4, 6, 8"]
    assert theirs.improvement is None
    assert ours.errors.shape == (3, len(CLIPS))
    wins = [
        (a > b) + (a == b) / 2
        for clip in range(len(CLIPS))
        for a in theirs.errors[:, clip]
        for b in ours.errors[:, clip]
    ]
    assert ours.improvement == pytest.approx(np.mean(wins))
    assert ours.improvement < 0.5
    middle = np.sort(ours.errors.ravel())[9:27]
    assert ours.middle == pytest.approx(middle.mean())
    text = page([Chapter(sweep, table_of(sweep, find), runs_of(sweep, find))], [], "now", "0")
    assert f"<td>{ours.middle:.2f}</td><td>{ours.improvement:.2f}</td>" in text


def test_an_arm_that_diverges_on_hard_clips_does_not_look_better_for_it(tmp_path: Path):
    sweep = load_sweep(SHIPPED / "table14.yaml")
    runs = runs_of(sweep, fake_sweep(tmp_path, sweep, {"2": 0.5}))
    branch = sweep.variants[0].branch

    def of(label: str) -> Distribution:
        found = distributions(sweep, runs, "stream")["MPJPE"]
        return next(one for one in found if one.label == label)

    before, clips = of("2"), runs["2"][0].clips
    hard = max(clips, key=lambda clip: clips[clip]["stream"][branch]["MPJPE"])
    clips[hard]["stream"][branch]["MPJPE"] = math.nan
    after = of("2")
    assert after.errors.shape == before.errors.shape
    assert after.middle == before.middle  # beyond the middle half either way
    assert before.improvement == 1
    assert after.improvement == pytest.approx(1 - 3 / (9 * len(CLIPS)))  # one of its three seeds
    for run in (run for found in runs.values() for run in found.values()):  # the clip is too short
        run.clips[hard]["stream"][branch]["MPJPE"] = math.nan
    assert of("2").errors.shape == (3, len(CLIPS) - 1)
    for run in runs["2"].values():
        del run.means["stream"][branch]["MPJPE"]
    assert (of("2").errors.size, of("2").middle) == (0, None)  # not measured, which is not diverged


def test_an_interquartile_mean_below_a_tenth_has_two_digits():
    found = [_robust_words(Distribution("a", np.zeros((1, 1)), middle, None)) for middle in (0.0034, 4.2)]
    assert found == [("0.0034", "-"), ("4.20", "-")]


def test_an_arm_has_its_colour_in_each_panel():
    """Also where the first arm has no curve, as one that was validated only once."""
    curve = figures.Curve((0, 1, 2), (2.0, 2.0, 2.0))
    loss = {label: [curve] for label in "ABC"}
    svg = figures.curves("losses", {"loss": loss, "MPJPE": {"B": [curve], "C": [curve]}})
    found = re.findall(r"stroke: var\(--series(\d)\)", svg)
    assert found == ["0", "1", "2", "1", "2", "0", "1", "2"]  # two panels and the legend


def test_a_point_of_accuracy_is_what_the_table_says():
    """Its time is that of the seed that had a core to itself, its error that of all seeds."""
    runs = {
        seed: SimpleNamespace(costs={"FPS": fps, "core share": share}, value=lambda *_, seed=seed: 3.0 + seed)
        for seed, (fps, share) in enumerate([(1000.0, 0.99), (400.0, 0.4), (420.0, 0.45)])
    }
    (point,) = _points(SimpleNamespace(runs={"arm": runs}))
    assert (point.fps, point.error) == (1000.0, 4.0)


def test_an_arm_that_diverged_is_no_point_of_accuracy_and_is_named(tmp_path: Path):
    sweep = load_sweep(SHIPPED / "table14.yaml")
    runs = runs_of(sweep, fake_sweep(tmp_path, sweep))
    chapter = Chapter(sweep, table_of(sweep, fake_sweep(tmp_path, sweep)), runs)
    assert "Not drawn" not in "".join(_accuracy([chapter], []))
    runs["2"][0].means["stream"]["rotation"]["MPJRE"] = math.nan
    (figure,) = _accuracy([chapter], [])
    assert "Not drawn, since a run of it diverged: &#x27;2&#x27; of Table 14" in figure


@pytest.mark.slow
def test_colours_are_the_pages(text: str):
    assert "#0102" not in text
    assert "var(--series0)" in text
    assert "currentColor" in text


@pytest.mark.slow
def test_config_differences(text: str):
    rows = re.findall(r"<tr><th scope=\"row\"><code>\w+</code></th>(.*?)</tr>", text)
    seeds = [row for row in rows if "table14: 2, 4, 6, seed 2" in row and "config" not in row]
    assert any("seed=2" in row and "&#x27;memory.layers=[2,4,6]&#x27;" in row for row in seeds)


@pytest.mark.slow
def test_labels_are_escaped(tmp_path: Path):
    content = (
        "variants: {'<script>alert(1)</script>': [a=b], '& <b>': [a=c]}\ntitle: <i>title</i>\nseeds: [0, 1]\n"
    )
    (tmp_path / "bad.yaml").write_text(content)
    sweep = load_sweep(tmp_path / "bad.yaml")
    find = fake_sweep(tmp_path, sweep, {"& <b>": 1.1}, log=True)
    text = page([Chapter(sweep, table_of(sweep, find), runs_of(sweep, find))], [], "now", "0")
    assert "<script" not in text
    assert "<b>" not in text
    assert "<i>" not in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in text


def test_nothing_measured_is_said():
    sweep = load_sweep(SHIPPED / "table14.yaml")
    text = page([Chapter(sweep, table_of(sweep, nothing), runs_of(sweep, nothing))], [], "now", "0")
    assert "Nothing measured yet." in text
    assert "fill with: memmlp sweep table14" in text
    assert "<svg" not in text


def test_deployments_of_one_run_have_a_row_each(tmp_path: Path):
    sweep = replace(load_sweep(SHIPPED / "table14.yaml"), seeds=(0,))
    runs = runs_of(sweep, fake_sweep(tmp_path, sweep))
    one, two = list(runs)[:2]
    slower = {**runs[one][0].latency, "median_ms": 5.0}
    runs[two] = {0: replace(runs[one][0], latency=slower, costs={"ms": 5.0})}
    found = page([Chapter(sweep, make_table(sweep, runs), runs)], [], "now", "0")
    rows = re.findall(rf"<tr><th[^>]*><code>{runs[one][0].id}</code></th>(.*?)</tr>", found)
    assert {"<td>5.00</td>" in row for row in rows if "<td>1.10</td>" in row} == {True, False}
    assert f"{len(runs) - 1} finished runs stand" in found


def test_latencies_are_those_of_the_file_that_was_asked_for(tmp_path: Path):
    sweep = replace(load_sweep(SHIPPED / "table14.yaml"), seeds=(0,))
    runs = runs_of(sweep, fake_sweep(tmp_path, sweep))
    one = next(iter(runs))
    run = runs[one][0]
    less = {"settings": {"precision": "int8"}, "int8": {"median_ms": 0.25, "p95_ms": 0.5, "onnx_bytes": 6e6}}
    runs[one] = {
        0: replace(run, latency={**run.latency, **less}, origin=replace(run.origin, deployed="int8"))
    }
    found = page([Chapter(sweep, make_table(sweep, runs), runs)], [], "now", "0")
    (row,) = re.findall(rf"<tr><th[^>]*><code>{run.id}</code></th>(<td>int8.*?)</tr>", found)
    cells = re.findall(r"<td>(.*?)</td>", row)
    assert (cells[:3], cells[7]) == (["int8", "0.25", "0.50"], "6.00")


def test_more_may_be_better(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Of a metric of one's own that counts what is right."""
    monkeypatch.setattr("memmlp.tables.table_text.HIGHER", {"MPJPE"})
    monkeypatch.setattr("memmlp.tables.error_distributions.HIGHER", {"MPJPE"})
    sweep = load_sweep(SHIPPED / "table14.yaml")
    find = fake_sweep(tmp_path, sweep, {"2": 2.0})
    runs = runs_of(sweep, find)
    found = distributions(sweep, runs, "stream")
    better = {
        metric: next(one.improvement for one in arms if one.label == "2") for metric, arms in found.items()
    }
    assert (better["MPJPE"], better["Jitter"]) == (1.0, 0.0)
    text = page([Chapter(sweep, table_of(sweep, find), runs)], [], "now", "0")
    assert "Left is better, of MPJPE right." in text
    assert "Further up and left is better, of MPJPE further down and right." in text


@pytest.fixture
def report(tmp_path: Path, text: str) -> str:
    """The address of the page as a file."""
    path = tmp_path / "report.html"
    path.write_text(text, encoding="utf-8")
    return path.as_uri()


@pytest.mark.slow
@pytest.mark.parametrize("width", [1280, 390])
def test_browser_shows_the_page(report: str, chapters: list[Chapter], width: int):
    with Browser(width, 900) as browser:
        browser.open(report)
        assert browser.value("innerWidth") == width
        outside = "!e.closest('.scroll') && e.getBoundingClientRect().right > innerWidth + 1"
        assert browser.value(f"[...document.querySelectorAll('main *')].filter(e => {outside}).length") == 0
        heights = "[...document.querySelectorAll('svg, table')].map(e => e.getBoundingClientRect().height)"
        assert min(browser.value(heights)) >= 30
        assert browser.value("document.querySelectorAll('svg').length") == 11
        for chapter in chapters:
            assert browser.value(f"document.getElementById('{chapter.sweep.name}') !== null")
        assert browser.errors == []


@pytest.mark.slow
def test_browser_tells_of_errors(tmp_path: Path):
    """What a page's script throws is seen, so that the test above can fail."""
    path = tmp_path / "bad.html"
    path.write_text("<script>throw new Error('loud')</script><img src='http://example.invalid/x.png'>")
    with Browser() as browser:
        browser.open(path.as_uri())
        assert any("loud" in error for error in browser.errors)


@pytest.mark.slow
def test_browser_prints_the_page(report: str):
    with Browser() as browser:
        browser.open(report)
        assert len(base64.b64decode(browser.call("Page.printToPDF")["data"])) > 50_000


@pytest.fixture
def planned(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Replace planning: Table 6 is measured, Table 5 but for an arm, and the others can't be planned."""

    def plan(sweep: Sweep, outputs: Path, prepare: bool = False) -> Plan:
        if sweep.table not in (5, 6):
            raise InputError("data.root: has no value")
        find = fake_sweep(tmp_path / sweep.name, sweep, clips=CLIPS[:4])
        entries = [(arm, seed) for arm in sweep.runnable() for seed in sweep.seeds]
        found = [Entry(arm.label, seed, find(arm, seed).id) for arm, seed in entries]  # type: ignore[union-attr]
        if sweep.table == 5:
            for entry in found[-len(sweep.seeds) :]:
                shutil.rmtree(Run.of(tmp_path / sweep.name, entry.id).folder)
        return Plan(sweep.name, tmp_path / sweep.name, tuple(found), ())

    monkeypatch.setattr("memmlp.config.compose_plan.kept_or_new_plan", plan)


@pytest.mark.slow
def test_command_writes_the_page(memmlp: Memmlp, planned: None):
    ran = memmlp("report", "5", "table06", "data=mocap", "--out", "here/page.html")
    assert (ran.code, ran.out) == (0, "here/page.html\n")
    text = Path("here/page.html").read_text()
    assert set(re.findall(r'class="result" id="(\w+)"', text)) == {"table05", "table06"}


@pytest.mark.slow
def test_command_takes_all_by_default(memmlp: Memmlp, planned: None):
    assert memmlp("report").out == "outputs/report.html\n"
    text = Path("outputs/report.html").read_text()
    assert len(re.findall(r'class="result" id="table\d\d"', text)) == 17
    assert 'id="memory_control"' in text
    tables = re.findall(r'class="result" id="(table\d\d)"', text)
    assert tables[:3] == ["table06", "table05", "table01"]  # what is measured, in part or not at all
    assert "<details><summary>Contents</summary>" in text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["99"], ("no such sweep",)), (["5", "--out", "/proc/no/x"], ("--out /proc/no/x",))],
)
def test_bad_input_is_one_line(memmlp: Memmlp, planned: None, arguments: list[str], words: tuple[str, ...]):
    assert one_line(memmlp("report", *arguments), *words)
