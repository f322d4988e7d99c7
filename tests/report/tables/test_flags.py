"""What a reader has to know of the runs, a line each."""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from fake_runs import CLIPS, ORIGIN, fake_run, fake_sweep, nothing, runs_of, table_of
from fake_table import cell, printed

from memmlp.report.kept_results import Kept, dumps, load_kept
from memmlp.report.result_pages import describe_origin
from memmlp.report.tables.build_table import make_table
from memmlp.report.tables.formats import FORMATS
from memmlp.report.tables.measured_run import Measured, load
from memmlp.report.tables.statistics import Verdict
from memmlp.report.tables.table import Table
from memmlp.runs.evaluation_file import write_report
from memmlp.runs.run import Run
from memmlp.sweep.definition import Sweep, Variant


def test_a_protocol_on_amass_with_other_data_is_flagged(sweep: Sweep):
    runs = runs_of(sweep, nothing)
    protocol = replace(sweep, table=1, base=("data=amass_s1",))
    other = replace(protocol, command_line=("data=mocap", "data.root=mine"))
    flag = "a table of data=amass_s1, shown with data=mocap: its errors do not compare with the paper's"
    assert flag in make_table(other, runs).flags
    alike = (protocol, replace(protocol, command_line=("data=amass_s1",)), replace(other, base=()))
    assert not any("a table of" in word for one in alike for word in make_table(one, runs).flags)


def test_missing_runs_are_shown_with_the_command(sweep: Sweep, tmp_path: Path):
    find = fake_sweep(tmp_path, sweep)
    unfinished = find(sweep.variants[1], 1)
    assert unfinished is not None
    unfinished.marker.unlink()
    unfinished.fail("loss is NaN")
    gone = {("by position", seed) for seed in (0, 1, 2)}
    table = table_of(
        sweep,
        lambda variant, seed: None if (variant.label, seed) in gone else find(variant, seed),
        command="memmlp sweep 11 data=mocap",
    )
    rows = {row.label: row for row in table.rows}
    assert (rows["no | memory"].found, rows["by position"].found) == ((0, 2), ())
    gaps = "'no | memory' seed 1 (failed), 'by position' seed 0, 1, 2"
    assert f"missing: {gaps}; fill with: memmlp sweep 11 data=mocap" in table.flags
    effect = cell(table, "no | memory", "MPJPE").effect
    assert effect is not None
    assert effect.seeds == 2
    assert cell(table, "by position", "MPJPE").effect is None
    early = [flag for flag in table.flags if flag.startswith("seeds are missing")]
    assert [flag.rpartition(": ")[2] for flag in early] == ["'no | memory'"]
    assert "2/3" in printed(table, 100)
    assert "0/3" in FORMATS["md"](table)


def test_unequal_clips_are_flagged_and_left_out(sweep: Sweep, tmp_path: Path):
    runs = {
        (variant.label, seed): fake_run(
            tmp_path, variant.label, seed, clips=CLIPS[:3] if variant.label == "full_model" else CLIPS[1:4]
        )
        for variant in sweep.runnable()
        for seed in (0, 1)
    }
    table = table_of(replace(sweep, seeds=(0, 1)), lambda variant, seed: runs[variant.label, seed])
    effect = cell(table, "no | memory", "MPJPE").effect
    assert effect is not None
    assert effect.clips == 2
    assert abs(effect.mean) < 0.3  # the clip that is far harder than the others is in one variant alone
    assert sum("unequal test clips" in flag and "share 2 of 4" in flag for flag in table.flags) == 2


def test_a_clip_that_is_no_number_is_left_out(sweep: Sweep, tmp_path: Path):
    find = fake_sweep(tmp_path, sweep)
    run = find(sweep.variants[3], 1)
    assert run is not None
    path = run.evaluation("stream-0")
    report = json.loads(path.read_text())
    report["clips"][0]["rotation"]["Jitter"] = "nan"
    write_report(path, {key: report[key] for key in ("mode", "mean", "clips")})
    table = table_of(sweep, find)
    assert [cell(table, "no | memory", metric).effect.clips for metric in ("Jitter", "MPJPE")] == [11, 12]


@pytest.mark.parametrize("word", ["nan", "inf"])
def test_a_network_that_diverged_on_a_clip_is_said(sweep: Sweep, tmp_path: Path, word: str):
    """What its variant is compared by are the clips where it did not; too short a clip is short for all."""
    find = fake_sweep(tmp_path, sweep)
    for variant in sweep.runnable():
        for seed in sweep.seeds:
            path = find(variant, seed).evaluation("stream-0")
            report = json.loads(path.read_text())
            for branch in ("rotation", "position"):
                report["clips"][0][branch]["Jitter"] = "nan"
            for number in (1, 2) if (variant.label, seed) == (sweep.variants[3].label, 1) else ():
                report["clips"][number]["rotation"]["MPJPE"] = word
            path.write_text(json.dumps(report))
    table = table_of(sweep, find)
    assert [cell(table, "no | memory", metric).effect.clips for metric in ("Jitter", "MPJPE")] == [11, 10]
    (flag,) = (flag for flag in table.flags if flag.startswith("NaN errors"))
    assert flag.endswith(": 'full_model' seed 1 (2 clips)")


def test_a_mean_of_fewer_seeds_than_its_row_counts_is_said(sweep: Sweep, tmp_path: Path):
    runs = runs_of(sweep, fake_sweep(tmp_path, sweep))
    variant = sweep.runnable()[0]
    for mode in ("stream", "window"):
        del runs[variant.label][1].means[mode][variant.branch]["Jitter"]
    del runs[variant.label][2].costs["ms"]
    for one in runs["by position"].values():  # none of its seeds has one
        del one.means["stream"]["position"]["Jitter"]
    (line,) = (flag for flag in make_table(sweep, runs).flags if "not measured" in flag)
    assert line == (
        "not measured, so the mean is of the other seeds: "
        "'no | memory' seed 1 (Jitter), 'no | memory' seed 2 (ms)"
    )


def test_a_clip_on_which_every_run_diverged_is_flagged(sweep: Sweep, tmp_path: Path):
    """It is not too short for a metric: the shortest clip has position errors."""
    runs = runs_of(sweep, fake_sweep(tmp_path, sweep))
    for run in (run for of_variant in runs.values() for run in of_variant.values()):
        for mode, branch in itertools.product(run.means, ("rotation", "position")):
            errors = next(iter(run.clips.values()))[mode][branch]
            errors.update(dict.fromkeys(errors, math.nan))
    (line,) = (flag for flag in make_table(sweep, runs).flags if "NaN errors" in flag)
    assert all(f"'{variant.label}' seed 0 (1 clips)" in line for variant in sweep.runnable())


def test_networks_that_hardly_saw_motion_are_told(sweep: Sweep, tmp_path: Path):
    """As with `profile=tiny`, whose tables otherwise look like any other."""
    small, tiny = (
        {"optim": {"steps": steps, "batch": batch}, "model": {"frames": frames}}
        for steps, batch, frames in ((2000, 32, 41), (20, 8, 11))
    )

    def flags(*hardly: str) -> list[str]:
        runs = {
            variant.label: fake_run(
                tmp_path, variant.label, config=tiny if variant.label in hardly else small
            )
            for variant in sweep.runnable()
        }
        table = table_of(replace(sweep, seeds=(0,)), lambda variant, seed: runs[variant.label])
        return [flag for flag in table.flags if "hardly" in flag]

    said = "hardly trained (its steps saw 0.49 minutes of motion): ignore its errors"
    assert flags() == []
    assert flags("no | memory") == [f"{said}: 'no | memory'"]
    assert flags(*(variant.label for variant in sweep.runnable())) == [f"{said}: every variant"]


def test_motion_smoother_than_the_truth_is_flagged(sweep: Sweep, tmp_path: Path):
    """Where a network hardly follows, the best Jitter of a table is its own."""
    find = fake_sweep(tmp_path, sweep)
    assert not any(
        "smoother" in flag for flag in table_of(sweep, find).flags
    )  # nothing is known of the truth
    for variant in sweep.runnable():
        for seed in sweep.seeds:
            path = find(variant, seed).evaluation("stream-0")
            report = json.loads(path.read_text())
            of_branch = report["mean"][variant.branch]
            of_branch["GT Jitter"] = 6.0
            of_branch["Jitter"] = 7.0 if variant.label != "no | memory" else 5.0 + seed / 2
            write_report(path, {key: report[key] for key in ("mode", "mean", "clips")})
    line = "Jitter below the truth's 6.00 (stream): 'no | memory' 5.50"
    line += "; motion that is smoother than the truth is not better"
    assert [flag for flag in table_of(sweep, find).flags if "smoother" in flag] == [line]
    path = find(sweep.variants[1], 0).evaluation(
        "stream-0"
    )  # a seed that diverged hides the others from nobody
    report = json.loads(path.read_text())
    report["mean"][sweep.variants[1].branch]["Jitter"] = "nan"
    write_report(path, {key: report[key] for key in ("mode", "mean", "clips")})
    (flag,) = [flag for flag in table_of(sweep, find).flags if "smoother" in flag]
    assert flag == line.replace("5.50", "5.75")
    for seed in sweep.seeds:  # a variant on other clips, whose truth has 8.00
        path = find(sweep.variants[3], seed).evaluation("stream-0")
        report = json.loads(path.read_text())
        report["mean"][sweep.variants[3].branch]["GT Jitter"] = 8.0
        write_report(path, {key: report[key] for key in ("mode", "mean", "clips")})
    other = "Jitter below the truth's 8.00 (stream): 'full_model' 7.00"
    flags = [flag.partition(";")[0] for flag in table_of(sweep, find).flags if "smoother" in flag]
    assert flags == [flag.partition(";")[0], other]


def test_times_of_another_machine_than_the_controls_are_said(sweep: Sweep, tmp_path: Path):
    """A deployment may be made again anywhere, for instance in another precision."""
    find = fake_sweep(tmp_path, sweep)
    made_by = {"cpu": "A processor", "packages": {"onnxruntime": "1.9"}}
    for variant in sweep.runnable():
        for seed in sweep.seeds:
            path = find(variant, seed).deployment("fp32-0").latency
            path.write_text(json.dumps(json.loads(path.read_text()) | {"made_by": made_by}))
    assert not [flag for flag in table_of(sweep, find).flags if "machine" in flag]
    path.write_text(json.dumps(json.loads(path.read_text()) | {"made_by": {**made_by, "cpu": "A small one"}}))
    (flag,) = [flag for flag in table_of(sweep, find).flags if "machine" in flag]
    assert flag.startswith("machine of the times differs: A processor, ONNX Runtime 1.9 of ")
    assert f"A small one, ONNX Runtime 1.9 of '{variant.label}'" in flag
    unknown = find(sweep.runnable()[0], 0).deployment("fp32-0").latency  # an older one hides no other
    unknown.write_text(json.dumps(json.loads(unknown.read_text()) | {"made_by": {}}))
    assert [flag for flag in table_of(sweep, find).flags if "machine" in flag] == [flag]
    assert not [one for one in table_of(replace(sweep, metrics=("MPJPE",)), find).flags if "machine" in one]


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"ratio_to_yardstick": 0.8}, "(ratio 0.6 to 0.8 over seeds)"),
        ({"core_share": 0.52}, "(had a core for 52 % of the time)"),
        ({"core_share": 0.97, "alone_core_share": 0.52}, "(had a core for 52 % of the time)"),
        ({"pose_core_share": 0.52}, "(had a core for 52 % of the time)"),
        ({"ratio_to_yardstick": 0.7, "core_share": 0.97}, None),
    ],
)
def test_times_of_a_busy_machine_are_said(
    sweep: Sweep, tmp_path: Path, changed: dict[str, float], said: str | None
):
    """The ratio to a network timed in the same minute suffers, too: a long step is interrupted more often."""
    find = fake_sweep(tmp_path, sweep)
    path = find(sweep.variants[1], 1).deployment("fp32-0").latency
    path.write_text(json.dumps(json.loads(path.read_text()) | changed))
    found = [flag for flag in table_of(sweep, find).flags if "busy" in flag]
    line = f"timed on a busy machine, so that other work is in the times: 'no | memory' {said}"
    assert found == ([line] if said else [])
    assert not [flag for flag in table_of(replace(sweep, metrics=("MPJPE",)), find).flags if "busy" in flag]


def test_groups_that_differ_between_runs_are_said(sweep: Sweep, tmp_path: Path):
    find = fake_sweep(tmp_path, sweep, groups={clip: f"take {i // 2}" for i, clip in enumerate(CLIPS)})
    assert not any("data.split.groups" in flag for flag in table_of(sweep, find).flags)
    for path in find(sweep.runnable()[0], 1).evaluations.glob("*.json"):
        report = json.loads(path.read_text())
        report["clips"][0]["group"] = "alone"
        path.write_text(json.dumps(report))
    assert any("runs differ in the groups of test clips" in flag for flag in table_of(sweep, find).flags)


ORIGINS = [
    ({"git": {"commit": "fedcba9876543210", "dirty": False}}, ("code differs", "fedcba9", "0123456")),
    ({"git": ORIGIN["git"] | {"dirty": True}}, ("uncommitted changes", "'by position'")),
    ({"data": "e" * 64}, ("data differs", "dddddddd of 'no | memory', 'full_model'", "eeeeeeee of 'by")),
    ({"cpu": "Another one"}, ("hardware differs", "Another one of 'by position'")),
    ({"git": None}, ("code differs", "version 0.3.0 of 'by position'")),
    ({"device": "cuda"}, ("device differs", "cuda of 'by position'", "cpu of 'no | memory'")),
    ({"gpu": "A card"}, ("GPU differs", "A card of 'by position'", "none of ")),
    ({"processes": 2}, ("processes differs", "2 of 'by position'", "1 of 'no | memory'")),
    ({"threads": 2}, ("threads differs", "2 of 'by position'")),
    ({"packages": {"torch": "3.0"}}, ("torch differs", "3.0 of 'by position'")),
    ({"precision": "bf16"}, ("precision differs", "bf16 of 'by position'")),
    ({"recipes": {"memory": 2}}, ("recipe of memory differs", "2 of 'by position'")),
]


def test_runs_of_different_origin_are_flagged(sweep: Sweep, tmp_path: Path):
    for number, (change, words) in enumerate(ORIGINS):
        runs = {
            one.label: fake_run(
                tmp_path / str(number), one.label, origin=change if one.label == "by position" else None
            )
            for one in sweep.runnable()
        }
        table = table_of(replace(sweep, seeds=(0,)), lambda variant, seed, runs=runs: runs[variant.label])
        (flag,) = (flag for flag in table.flags if words[0] in flag)
        assert all(word in flag for word in words)
        assert any("one seed" in flag for flag in table.flags)


UPSTREAM = {**ORIGIN, "id": "a" * 16, "weights": "1" * 64}


ABOVE = [
    ({"git": ORIGIN["git"] | {"commit": "fedcba98"}}, "code differs: 0123456 of 'no | memory', "),
    ({"git": ORIGIN["git"] | {"commit": "fedcba98"}}, "; 0123456, fedcba9 of 'by position'"),
    ({"git": ORIGIN["git"] | {"dirty": True}}, "made by code with uncommitted changes: 'by position'"),
    ({"cpu": "Another one"}, "; A processor, Another one of 'by position'"),
    ({"gpu": "A card"}, "; none, A card of 'by position'"),
    ({"recipes": {"vqvae": 2}}, "recipe of vqvae differs: 1 of 'no | memory', 'full_model'; 2 of 'by po"),
    ({"sources": {"ik.py": "3"}}, "code of ik.py differs: "),
    ({"sources": {"ik.py": "3"}}, "code of ik.py has changed since these runs, under the same recipes: "),
    ({"weights": "2" * 64}, "weights of upstream run aaaaaaaaaaaaaaaa differs: 11111111 of "),
]


def test_runs_upon_upstream_runs_of_different_origin_are_flagged(
    sweep: Sweep, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """A VQ-VAE by other code, on another machine, or trained again under its id, is in every error."""
    monkeypatch.setattr("memmlp.report.tables.flags.code_digests", lambda packages: {"ik.py": "1"})
    usual = UPSTREAM | {"recipes": {"vqvae": 1}, "sources": {"ik.py": "1"}}

    def flags(change: dict) -> set[str]:
        def run(variant: Variant, seed: int) -> Run:
            above = usual | (change if variant.label == "by position" else {})
            made = {"upstream": above["id"], "upstream_runs": [above], "sources": {"ik.py": "1"}}
            return fake_run(tmp_path / str(len(str(change))), variant.label, seed, origin=made)

        return set(table_of(sweep, run).flags)

    before = flags({})
    for change, words in ABOVE:
        assert any(words in flag for flag in flags(change) - before), words
        assert not any(words in flag for flag in before)


def test_seeds_upon_other_weights_of_one_upstream_run_are_flagged(sweep: Sweep, tmp_path: Path):
    """Also after they were kept, and where a training was resumed upon others; of old runs none is known."""
    weights = {0: ["1"], 1: ["1", "2"], 2: []}

    def run(variant: Variant, seed: int) -> Run:
        above = [UPSTREAM | {"weights": 64 * one} for one in weights[seed]]
        made = {"upstream": UPSTREAM["id"], **({"upstream_runs": above} if above else {})}
        return fake_run(tmp_path, variant.label, seed, origin=made)

    def said(runs) -> list[str]:
        return [flag for flag in make_table(sweep, runs).flags if "weights of upstream" in flag]

    runs = runs_of(sweep, run)
    every = "'no | memory', 'by position', 'full_model'"
    line = (
        f"digest of the weights of upstream run {'a' * 16} differs: 11111111 of {every}; 22222222 of {every}"
    )
    assert said(runs) == [line]
    path = tmp_path / "kept.json"
    path.write_text(dumps(Kept("table11", (), runs, {})))
    assert said(load_kept(path).runs) == [line]
    weights[1] = ["1"]
    assert said(runs_of(sweep, run)) == []


def test_files_that_differ_between_variants_of_one_commit_are_named(sweep: Sweep, tmp_path: Path):
    """As they do with other uncommitted changes; kept results have no digests of files."""
    terms, loop = "training/losses/terms.py", "training/loop.py"
    codes = {variant.label: {terms: "111", loop: "222", "a.py": "1"} for variant in sweep.runnable()}
    codes["by position"] |= {terms: "333", "mine:mine.py": "444"}

    def flags(read: Callable[[Path], Measured] = load) -> list[str]:
        def run(variant: Variant, seed: int) -> Run:
            return fake_run(tmp_path, variant.label, seed, origin={"sources": codes[variant.label]})

        found = make_table(sweep, runs_of(sweep, run, read)).flags
        return [flag for flag in found if "py differs" in flag]

    (said,) = flags()
    assert re.fullmatch(
        f"code of {terms} differs: \\w{{7}} of 'no \\| memory', 'full_model'; \\w{{7}} of 'by position'", said
    )
    assert flags(lambda folder: replace(load(folder), code={})) == []
    codes["by position"][loop] = "555"
    assert flags()[0].startswith(f"code of {loop}, {terms} differs: ")
    codes["by position"] |= codes["full_model"]
    assert flags() == []


def test_runs_from_before_code_changed_are_said(
    sweep: Sweep, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Code of memmlp and of packages of one's own, and what is alike is digested once."""
    asked: list[tuple[str, ...]] = []

    def today(packages: tuple[str, ...]) -> dict[str, str]:
        asked.append(packages)
        return {"training/loop.py": "1", "ik.py": "1", "new.py": "1", "mine:mine.py": "2"}

    monkeypatch.setattr("memmlp.report.tables.flags.code_digests", today)
    code = {"training/loop.py": "1", "ik.py": "1", "gone.py": "0"}
    old = {"full_model": code | {"ik.py": "0"}, "by position": code | {"mine:mine.py": "1"}}
    own = {"by position": {"mine": {"version": None, "digest": "d"}}}

    def flags() -> list[str]:
        def run(variant: Variant, seed: int) -> Run:
            made = {"sources": old.get(variant.label, code), "plugins": own.get(variant.label)}
            return fake_run(tmp_path, variant.label, seed, origin=made)

        return [flag for flag in table_of(sweep, run).flags if "has changed since" in flag]

    since = "has changed since these runs, under the same recipes: 'by position', 'full_model'"
    assert flags() == [f"code of ik.py, mine:mine.py {since}"]
    assert sorted(asked) == [(), ("mine",)]
    old.clear()
    assert flags() == []


def test_variants_that_saw_more_in_training_are_said(sweep: Sweep, tmp_path: Path):
    """A window twice as long, or a batch twice as large, is twice the data a step."""
    settings = {"optim": {"steps": 2000, "batch": 32}, "model": {"frames": 41}}
    nearly, more = (settings | {"model": {"frames": frames}} for frames in (40, 82))
    configs = {variant.label: dict(settings) for variant in sweep.runnable()}

    def flags() -> list[str]:
        runs = {label: fake_run(tmp_path, label, config=config) for label, config in configs.items()}
        table = table_of(replace(sweep, seeds=(0,)), lambda variant, seed: runs[variant.label])
        return [flag for flag in table.flags if "in training" in flag]

    assert flags() == []
    configs["by position"] = nearly
    assert flags() == []
    configs["by position"] = more
    line = "number of frames seen in training differs: 'by position' 5.25 M to 'full_model' 2.62 M"
    assert flags() == [line]
    configs["full_model"] = more
    assert len(flags()) == 1  # of the other variant now
    assert "'no | memory' 2.62 M to 'full_model' 5.25 M" in flags()[0]
    configs["full_model"] = {"optim": settings["optim"]}  # not known
    assert flags() == []


def test_what_any_seed_saw_in_training_counts(sweep: Sweep, tmp_path: Path):
    """Not that of the last one alone."""
    runs = runs_of(sweep, fake_sweep(tmp_path, sweep))
    for label, of_variant in runs.items():
        for seed, run in of_variant.items():
            more = 2 if (label, seed) == ("by position", 0) else 1
            of_variant[seed] = replace(run, training={"frames": more * 3e6})
    line = "number of frames seen in training differs: 'by position' 3-6 M to 'full_model' 3 M"
    assert [flag for flag in make_table(sweep, runs).flags if "in training" in flag] == [line]


def test_what_is_no_stream_is_said_in_every_format(sweep: Sweep, tmp_path: Path):
    late = {"by position": {"offline": True}}
    runs = {
        variant.label: fake_run(tmp_path, variant.label, evaluated=late.get(variant.label))
        for variant in sweep.runnable()
    }
    table = table_of(replace(sweep, seeds=(0,)), lambda variant, seed: runs[variant.label])
    assert "offline: uses future frames: 'by position'" in table.flags
    assert all("offline: uses" in write(table) for write in FORMATS.values())


def test_equal_origins_are_not_flagged(table: Table):
    assert [flag for flag in table.flags if "a group of its own" not in flag] == []


@pytest.mark.parametrize(
    ("tied", "said"),
    [
        (0, "each test clip is a group of its own"),
        (2, "10 of 12 test clips are groups of their own"),
        (6, None),
    ],
)
def test_test_clips_that_hardly_anything_ties_are_said(
    sweep: Sweep, tmp_path: Path, tied: int, said: str | None
):
    """A single tied pair does not say that people were told apart."""
    clips = [f"clip{number}" for number in range(12)]
    groups = {clip: "tied" if number < tied else clip for number, clip in enumerate(clips)}
    flags = table_of(sweep, fake_sweep(tmp_path, sweep, clips=clips, groups=groups)).flags
    whole = f"{said} (data.split.groups): right if no two share a person"
    assert [flag for flag in flags if "of their own" in flag or "of its own" in flag] == [whole] * bool(said)


@pytest.mark.parametrize(
    ("seeds", "clips", "said"),
    [
        (
            (0,),
            CLIPS[:1],
            ["one seed a variant and one group of test clips"],
        ),
        (
            (0,),
            CLIPS,
            ["one seed a variant: the intervals are about other clips"],
        ),
        ((0, 1), CLIPS[:1], ["one group of test clips: the intervals are about other seeds"]),
        ((0, 1), CLIPS, []),
    ],
)
def test_what_intervals_speak_of_is_said_once(
    sweep: Sweep, tmp_path: Path, seeds: tuple[int, ...], clips: tuple[str, ...], said: list[str]
):
    """One seed and one group leave nothing that an interval could speak of."""
    sweep = replace(sweep, seeds=seeds)
    table = table_of(sweep, fake_sweep(tmp_path, sweep, clips=clips))
    found = [flag for flag in table.flags if flag.startswith("one ")]
    assert [flag[: len(words)] for flag, words in zip(found, said, strict=True)] == said


def test_variants_that_share_a_single_seed_of_several_are_said(sweep: Sweep, tmp_path: Path):
    find, kept = fake_sweep(tmp_path, sweep), {"full_model": (0, 1)}
    table = table_of(
        sweep, lambda variant, seed: find(variant, seed) if seed in kept.get(variant.label, (1, 2)) else None
    )
    (line,) = (flag for flag in table.flags if flag.startswith("one seed"))
    assert line.endswith("about other clips alone and no star: 'no | memory', 'by position'")


def test_recipes_of_what_only_some_variants_have_do_not_differ(sweep: Sweep, tmp_path: Path):
    recipes = {"by position": {"recipes": {"memory": 1, "gru": 7}}}
    runs = {
        variant.label: fake_run(tmp_path, variant.label, origin=recipes.get(variant.label))
        for variant in sweep.runnable()
    }
    table = table_of(replace(sweep, seeds=(0,)), lambda variant, seed: runs[variant.label])
    assert not any("recipe" in flag for flag in table.flags)


@pytest.mark.parametrize(("shared", "flagged"), [(True, 1), (False, 0)])
def test_seeds_that_share_a_vqvae_are_flagged(sweep: Sweep, tmp_path: Path, shared: bool, flagged: int):
    runs = {
        (variant.label, seed): fake_run(
            tmp_path, variant.label, seed, origin={"upstream": "v" if shared else f"v{seed}"}
        )
        for variant in sweep.runnable()
        for seed in sweep.seeds
    }
    table = table_of(sweep, lambda variant, seed: runs[variant.label, seed])
    lines = [flag for flag in table.flags if "share one VQ-VAE" in flag]
    assert len(lines) == flagged
    assert all("'no | memory', 'by position', 'full_model'" in line for line in lines)


def test_one_group_of_clips_is_said_and_starred_by_nobody(sweep: Sweep, tmp_path: Path):
    find = fake_sweep(tmp_path, sweep, {"no | memory": 2.0}, groups=dict.fromkeys(CLIPS, "one"))
    table = table_of(sweep, find)
    assert any("one group of test clips" in flag for flag in table.flags)
    assert table.comparisons == 0
    effect = cell(table, "no | memory", "MPJPE").effect
    assert (effect.significant, effect.verdict) == (False, Verdict.INCONCLUSIVE)
    assert "*" not in printed(table, 100)


@pytest.mark.parametrize(
    ("number", "body", "flagged"), [(1, "builtin", 1), (1, "SMPL-H", 0), (4, "builtin", 0)]
)
def test_the_built_in_body_beside_smplh_numbers(
    sweep: Sweep, tmp_path: Path, number: int, body: str, flagged: int
):
    sweep = replace(sweep, table=number)
    table = table_of(sweep, fake_sweep(tmp_path, sweep, origin={"body": body}))
    assert sum("data.body" in flag for flag in table.flags) == flagged


def test_runs_of_an_older_recipe_are_named(sweep: Sweep, tmp_path: Path):
    runs = runs_of(sweep, fake_sweep(tmp_path, sweep))
    runs["no | memory"] = {seed: run for seed, run in runs["no | memory"].items() if seed}
    table = make_table(
        sweep, runs, older=lambda variant, seed: "abc" if variant.label != "full_model" else None
    )
    assert "made by an earlier recipe, left out and made again by the sweep: 'no | memory' seed 0 (abc)" in (
        table.flags
    )


def test_a_part_of_a_list_is_said_wherever_its_runs_are(sweep: Sweep, tmp_path: Path):
    part = "amass_s1, 61 % of the list (3262 of 5350 entries)"
    variants = sweep.runnable()
    runs = {
        variant.label: fake_run(
            tmp_path, variant.label, origin={"partial": part} if variant is variants[0] else None
        )
        for variant in variants
    }
    one = replace(sweep, seeds=(0,))
    assert (
        f"{part}, and no more: '{variants[0].label}'"
        in table_of(one, lambda variant, seed: runs[variant.label]).flags
    )
    measured = {variant.label: {0: load(runs[variant.label].folder)} for variant in variants}
    path = tmp_path / "kept.json"
    path.write_text(dumps(Kept("5", (), measured, {variant.label: () for variant in variants})))
    kept = load_kept(path)
    assert {run.origin.partial for run in kept.every} == {part, None}
    assert part in describe_origin(kept).replace("\\", "")  # escaped for Markdown


@pytest.mark.parametrize(
    ("fact", "said"),
    [
        (
            "divided",
            "clips of CMU/01 and 2 more are in training and in test; data=amass_s3 keeps subjects apart",
        ),
        ("resampled", "2 of 6 test clips were recorded at 30 Hz and go on by straight lines"),
        ("unusual", "1 of 6 test clips are unusual, first a (Z is not up)"),
    ],
)
def test_what_runs_say_of_their_data_is_flagged_with_their_names(
    sweep: Sweep, tmp_path: Path, fact: str, said: str
):
    """People of the training in the test, or clips whose truth has kinks; kept results know it, too."""
    variants = [variant.label for variant in sweep.runnable()]
    runs = {
        label: fake_run(tmp_path, label, origin={fact: said} if label != variants[0] else None)
        for label in variants
    }
    flagged = table_of(replace(sweep, seeds=(0,)), lambda variant, seed: runs[variant.label]).flags
    assert f"{said}: {', '.join(map(repr, variants[1:]))}" in flagged
    measured = {label: {0: load(runs[label].folder)} for label in variants}
    path = tmp_path / "kept.json"
    path.write_text(dumps(Kept("5", (), measured, {label: () for label in variants})))
    assert {getattr(run.origin, fact) for run in load_kept(path).every} == {said, None}
    assert f'"{fact}": null' not in path.read_text()  # files of before keep their bytes
