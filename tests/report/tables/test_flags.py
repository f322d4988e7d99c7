"""Flags of a table: what a reader has to know about its runs."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fake_runs import CLIPS, ORIGIN, fake_run, fake_sweep, nothing, runs_of, table_of, write_evaluation
from fake_table import cell, printed

from memmlp.report.tables.build_table import make_table
from memmlp.report.tables.statistics import Verdict
from memmlp.report.tables.table_text import FORMATS
from memmlp.runs.run import Run
from memmlp.sweep.definition import Sweep

LABELS = ("no | memory", "by position", "full_model")
EVERY = ", ".join(map(repr, LABELS))


@pytest.fixture
def flags(sweep: Sweep, tmp_path: Path) -> Callable[..., list[str]]:
    """Return the flags with certain words, of runs that `settings(label, seed)` of `fake_run` make."""

    def flags(
        words: str, settings: Callable[[str, int], dict[str, Any]] = lambda *_: {}, seeds=(0,), **changes: Any
    ) -> list[str]:
        part = replace(sweep, seeds=seeds, **changes)
        runs = {
            (one.label, seed): fake_run(tmp_path, one.label, seed, **settings(one.label, seed))
            for one in part.list_runnable()
            for seed in seeds
        }
        table = table_of(part, lambda variant, seed: runs[variant.label, seed])
        return [flag for flag in table.flags if words in flag]

    return flags


def edit(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    content = json.loads(path.read_text())
    change(content)
    if "digest" in content:
        write_evaluation(path, content)
    else:
        path.write_text(json.dumps(content))


def runs_in(sweep: Sweep, find: Callable[..., Run]) -> dict[tuple[str, int], Run]:
    return {(one.label, seed): find(one, seed) for one in sweep.list_runnable() for seed in sweep.seeds}


def test_a_protocol_on_amass_with_other_data(sweep: Sweep):
    runs = runs_of(sweep, nothing)
    protocol = replace(sweep, table=1, base=("data=amass_s1",))
    other = replace(protocol, command_line=("data=mocap", "data.root=mine"))
    flag = "a table of data=amass_s1, shown with data=mocap: errors are not comparable with the paper"
    assert flag in make_table(other, runs).flags
    same = (protocol, replace(protocol, command_line=("data=amass_s1",)), replace(other, base=()))
    assert not any("a table of" in flag for one in same for flag in make_table(one, runs).flags)


def test_missing_runs_have_their_command(sweep: Sweep, tmp_path: Path):
    find = fake_sweep(tmp_path, sweep)
    unfinished = find(sweep.variants[1], 1)
    unfinished.marker.unlink()
    unfinished.fail("loss is NaN")
    some = lambda variant, seed: None if variant.label == "by position" else find(variant, seed)  # noqa: E731
    table = table_of(sweep, some, command="memmlp sweep 11 data=mocap")
    assert [row.found for row in table.rows] == [(), (0, 2), (), (0, 1, 2)]
    gaps = "'no | memory' seed 1 (failed), 'by position' seed 0, 1, 2"
    assert f"missing: {gaps}; fill with: memmlp sweep 11 data=mocap" in table.flags
    assert cell(table, "no | memory", "MPJPE").effect.seeds == 2
    assert cell(table, "by position", "MPJPE").effect is None
    (early,) = [flag for flag in table.flags if flag.startswith("seeds are missing")]
    assert early.endswith(": 'no | memory'")
    assert "2/3" in printed(table, 100)


def test_unequal_clips_are_left_out(sweep: Sweep, tmp_path: Path):
    def run(variant, seed: int) -> Run:
        clips = CLIPS[:3] if variant.label == "full_model" else CLIPS[1:4]
        return fake_run(tmp_path, variant.label, seed, clips=clips)

    table = table_of(replace(sweep, seeds=(0, 1)), run)
    effect = cell(table, "no | memory", "MPJPE").effect
    assert effect.clips == 2
    assert abs(effect.mean) < 0.3  # the clip that is far harder than the others is in one variant alone
    assert sum("unequal test clips" in flag and "share 2 of 4" in flag for flag in table.flags) == 2


@pytest.mark.parametrize("word", ["nan", "inf"])
def test_clips_on_which_a_network_diverged(sweep: Sweep, tmp_path: Path, word: str):
    """A variant is compared on the other clips; a clip without a Jitter in any run is too short for it."""
    find = fake_sweep(tmp_path, sweep)

    def spoil(run: Run, number: int, metric: str, value: str, *branches: str) -> None:
        change = lambda report: [report["clips"][number][b].update({metric: value}) for b in branches]  # noqa: E731
        edit(run.evaluation("stream-0"), change)

    def flagged() -> str:
        (flag,) = (flag for flag in table_of(sweep, find).flags if flag.startswith("NaN errors"))
        return flag

    runs = runs_in(sweep, find)
    for run in runs.values():
        spoil(run, 0, "Jitter", "nan", "rotation", "position")
    for number in (1, 2):
        spoil(runs["full_model", 1], number, "MPJPE", word, "rotation")
    cells = [cell(table_of(sweep, find), "no | memory", metric) for metric in ("Jitter", "MPJPE")]
    assert [one.effect.clips for one in cells] == [11, 10]
    assert flagged().endswith(": 'full_model' seed 1 (2 clips)")
    for run in runs.values():  # a clip without a position error in any run is not too short
        spoil(run, 0, "MPJPE", "nan", "rotation", "position")
    assert all(f"'{variant.label}' seed 0 (1 clips)" in flagged() for variant in sweep.list_runnable())


def test_a_mean_of_fewer_seeds_than_its_row_counts(sweep: Sweep, tmp_path: Path):
    runs = runs_of(sweep, fake_sweep(tmp_path, sweep))
    variant = sweep.list_runnable()[0]
    for mode in ("stream", "window"):
        del runs[variant.label][1].means[mode][variant.branch]["Jitter"]
    del runs[variant.label][2].costs["ms"]
    for one in runs["by position"].values():  # none of its seeds has one
        del one.means["stream"]["position"]["Jitter"]
    (flag,) = (flag for flag in make_table(sweep, runs).flags if "not measured" in flag)
    assert flag.endswith("other seeds: 'no | memory' seed 1 (Jitter), 'no | memory' seed 2 (ms)")


def test_networks_that_hardly_saw_motion(flags: Callable[..., list[str]]):
    small, tiny = (
        {"config": {"optim": {"steps": steps, "batch": batch}, "model": {"frames": frames}}}
        for steps, batch, frames in ((2000, 32, 41), (20, 8, 11))
    )
    flag = "hardly trained (its steps saw 0.49 minutes of motion): ignore its errors"
    for labels, found in (((), None), (("full_model",), "'full_model'"), (LABELS, "every variant")):
        made = flags("hardly", lambda label, _, labels=labels: tiny if label in labels else small)
        assert made == ([f"{flag}: {found}"] if found else [])


def test_motion_smoother_than_the_truth(sweep: Sweep, tmp_path: Path):
    """Variants on other clips have another truth, and a line of their own."""
    find = fake_sweep(tmp_path, sweep)
    runs, branches = runs_in(sweep, find), {one.label: one.branch for one in sweep.variants}

    def smoother() -> list[str]:
        found = (flag.partition(";")[0] for flag in table_of(sweep, find).flags)
        return [flag for flag in found if flag.startswith("Jitter below")]

    def change(label: str, seed: int, **values: float | str) -> None:
        path = runs[label, seed].evaluation("stream-0")
        edit(path, lambda report: report["mean"][branches[label]].update(values))

    assert smoother() == []  # nothing is known of the truth
    for label, seed in runs:
        jitter = 7.0 if label != "no | memory" else 5.0 + seed / 2
        change(label, seed, **{"GT Jitter": 6.0, "Jitter": jitter})
    assert smoother() == ["Jitter below the truth's 6.00 (stream): 'no | memory' 5.50"]
    change("no | memory", 0, Jitter="nan")  # a seed that diverged does not hide the others
    for seed in sweep.seeds:
        change("full_model", seed, **{"GT Jitter": 8.0})
    assert smoother() == [
        "Jitter below the truth's 6.00 (stream): 'no | memory' 5.75",
        "Jitter below the truth's 8.00 (stream): 'full_model' 7.00",
    ]


def test_times_of_other_machines(sweep: Sweep, tmp_path: Path):
    find = fake_sweep(tmp_path, sweep)
    runs = runs_in(sweep, find)
    made_by = {"cpu": "A processor", "packages": {"onnxruntime": "1.9"}}

    def change(label: str, seed: int, **made: Any) -> None:
        path = runs[label, seed].deployment("fp32-0").latency
        edit(path, lambda record: record.update(made_by=made))

    def machines(**changes: Any) -> list[str]:
        return [flag for flag in table_of(replace(sweep, **changes), find).flags if "machine" in flag]

    for label, seed in runs:
        change(label, seed, **made_by)
    assert machines() == []
    change("full_model", 2, **{**made_by, "cpu": "A small one"})
    (flag,) = machines()
    assert flag.startswith("machine of the times differs: A processor, ONNX Runtime 1.9 of ")
    assert "A small one, ONNX Runtime 1.9 of 'full_model'" in flag
    change("no | memory", 0)  # an unknown machine does not hide the others
    assert (machines(), machines(metrics=("MPJPE",))) == ([flag], [])


@pytest.mark.parametrize(("changed", "reason"), [
    ({"ratio_to_yardstick": 0.8}, "(ratio 0.6 to 0.8 over seeds)"),
    ({"core_share": 0.97, "alone_core_share": 0.52}, "(had a core for 52 % of the time)"),
    ({"pose_core_share": 0.52}, "(had a core for 52 % of the time)"),
    ({"ratio_to_yardstick": 0.7, "core_share": 0.97}, None),
])  # fmt: skip
def test_times_of_a_busy_machine(sweep: Sweep, tmp_path: Path, changed: dict[str, float], reason: str | None):
    find = fake_sweep(tmp_path, sweep)
    edit(find(sweep.variants[1], 1).deployment("fp32-0").latency, lambda record: record.update(changed))
    found = [flag for flag in table_of(sweep, find).flags if "busy" in flag]
    line = f"timed on a busy machine, so that other work is in the times: 'no | memory' {reason}"
    assert found == ([line] if reason else [])
    assert not [flag for flag in table_of(replace(sweep, metrics=("MPJPE",)), find).flags if "busy" in flag]


def test_groups_that_differ_between_runs(sweep: Sweep, tmp_path: Path):
    find = fake_sweep(tmp_path, sweep, groups={clip: f"take {i // 2}" for i, clip in enumerate(CLIPS)})
    assert not any("data.split.groups" in flag for flag in table_of(sweep, find).flags)
    for path in find(sweep.list_runnable()[0], 1).evaluations.glob("*.json"):
        edit(path, lambda report: report["clips"][0].update(group="alone"))
    assert any("runs differ in the groups of test clips" in flag for flag in table_of(sweep, find).flags)


ORIGINS = [
    ({"git": {"commit": "fedcba9876543210", "dirty": False}}, ("code differs", "fedcba9", "0123456")),
    ({"git": ORIGIN["git"] | {"dirty": True}}, ("uncommitted changes", "'by position'")),
    ({"data": "e" * 64}, ("data differs", "dddddddd of 'no | memory', 'full_model'", "eeeeeeee of 'by")),
    ({"device": "cuda"}, ("device differs", "cuda of 'by position'", "cpu of 'no | memory'")),
    ({"precision": "bf16"}, ("precision differs", "bf16 of")),
    ({"component_versions": {"memory": 2}}, ("memory differs", "2 of")),
]  # fmt: skip


def test_runs_of_different_origin(flags: Callable[..., list[str]]):
    assert [flag for flag in flags("") if "one seed" not in flag and "of its own" not in flag] == []

    def flags_by_position(words: str, change: dict) -> list[str]:
        return flags(words, lambda label, _: {"origin": change} if label == "by position" else {})

    for change, words in ORIGINS:
        (flag,) = flags_by_position(words[0], change)
        assert all(word in flag for word in words)
    assert flags_by_position("gru", {"component_versions": {"memory": 1, "gru": 7}}) == []  # of one variant


PREREQUISITES = {
    **ORIGIN, "id": "a" * 16, "weights": "1" * 64, "component_versions": {"vqvae": 1},
    "sources": {"ik.py": "1"},
}  # fmt: skip
CHANGED_PREREQUISITES = [
    ({"git": ORIGIN["git"] | {"commit": "fedcba98"}}, "code differs: 0123456 of 'no | memory', "),
    ({"git": ORIGIN["git"] | {"commit": "fedcba98"}}, "; 0123456, fedcba9 of 'by position'"),
    ({"git": ORIGIN["git"] | {"dirty": True}}, "made by code with uncommitted changes: 'by position'"),
    ({"component_versions": {"vqvae": 2}}, "of vqvae differs: 1 of 'no | memory', 'full_model'; 2 of 'by po"),
    ({"sources": {"ik.py": "3"}}, "code of ik.py has changed since these runs"),
    ({"weights": "2" * 64}, "aaaaaaaaaaaaaaaa differs: 11111111 of "),
]


def test_prerequisite_runs_of_different_origin(flags: Callable[..., list[str]], monkeypatch):
    """A VQ-VAE by other code, on another machine, or trained again under its id, affects every error."""
    monkeypatch.setattr("memmlp.report.tables.flags.compute_code_digests", lambda packages: {"ik.py": "1"})

    def flags_upon(change: dict[str, Any]) -> list[str]:
        def settings(label: str, _: int) -> dict[str, Any]:
            run = PREREQUISITES | (change if label == "by position" else {})
            above = {"prerequisite": run["id"], "prerequisite_runs": [run]}
            return {"origin": {**above, "sources": {"ik.py": "1"}}}

        return flags("", settings)

    before = flags_upon({})
    for change, words in CHANGED_PREREQUISITES:
        assert any(words in flag for flag in flags_upon(change)), words
        assert not any(words in flag for flag in before)


def test_variants_that_saw_more_in_training(flags: Callable[..., list[str]]):
    """A window twice as long, or a batch twice as large, is twice the data a step."""

    def unequal(**lengths: int) -> list[str]:
        def settings(label: str, _: int) -> dict[str, Any]:
            frames = lengths.get(label.replace(" ", "_"), 41)
            return {"config": {"optim": {"steps": 2000, "batch": 32}, "model": {"frames": frames}}}

        return [flag.partition(" differs: ")[2] for flag in flags("in training", settings)]

    assert unequal() == unequal(by_position=40) == []
    assert unequal(by_position=82) == ["'by position' 5.25 M to 'full_model' 2.62 M"]
    assert unequal(by_position=82, full_model=82) == ["'no | memory' 2.62 M to 'full_model' 5.25 M"]


def test_trainings_that_missed_their_compute(flags: Callable[..., list[str]]):
    """With equal budgets, trainings may see unequal numbers of frames."""

    def settings(label: str, _: int) -> dict[str, Any]:
        frames, tflop = (82, 5.2) if label == "full_model" else (41, 4.7)
        optim = {"steps": 2000, "batch": 32, "tflop": 5}
        return {"config": {"optim": optim, "model": {"frames": frames}}, "origin": {"tflop": tflop}}

    missed = "'no | memory' 4.7 instead of 5, 'by position' 4.7 instead of 5"
    assert flags("TFLOP", settings) == [f"training compute differs from optim.tflop, TFLOP: {missed}"]
    assert flags("frames seen", settings) == []


def test_offline_networks_in_every_format(sweep: Sweep, tmp_path: Path):
    def run(variant, _: int) -> Run:
        late = {"offline": True} if variant.label == "by position" else None
        return fake_run(tmp_path, variant.label, evaluated=late)

    table = table_of(replace(sweep, seeds=(0,)), run)
    assert "offline: uses future frames: 'by position'" in table.flags
    assert all("offline: uses" in write(table) for write in FORMATS.values())


@pytest.mark.parametrize(("tied", "expected"), [
    (0, "each test clip is a group of its own"),
    (3, "9 of 12 test clips are groups of their own"),
    (6, None),
])  # fmt: skip
def test_test_clips_with_hardly_any_groups(sweep: Sweep, tmp_path: Path, tied: int, expected: str | None):
    groups = {clip: "tied" if number < tied else clip for number, clip in enumerate(CLIPS)}
    flags = table_of(sweep, fake_sweep(tmp_path, sweep, groups=groups)).flags
    found = [flag.partition(" (data.split.groups)")[0] for flag in flags if "data.split.groups" in flag]
    assert found == ([expected] if expected else [])


@pytest.mark.parametrize(("seeds", "clips", "expected"), [
    ((0,), CLIPS[:1], ["one seed a variant and one group of test clips"]),
    ((0,), CLIPS, ["one seed a variant: the intervals are about other clips"]),
    ((0, 1), CLIPS[:1], ["one group of test clips: the intervals are about other seeds"]),
    ((0, 1), CLIPS, []),
])  # fmt: skip
def test_intervals_of_one_seed_or_group(sweep, tmp_path, seeds, clips, expected):
    sweep = replace(sweep, seeds=seeds)
    table = table_of(sweep, fake_sweep(tmp_path, sweep, {"no | memory": 2.0}, clips=clips))
    found = [flag for flag in table.flags if flag.startswith("one ")]
    assert [flag[: len(words)] for flag, words in zip(found, expected, strict=True)] == expected
    if len(clips) == 1:
        effect = cell(table, "no | memory", "MPJPE").effect
        assert (table.comparisons, effect.is_significant, effect.verdict) == (0, False, Verdict.INCONCLUSIVE)
        assert "*" not in printed(table, 100)


def test_seeds_that_share_a_vqvae(flags: Callable[..., list[str]]):
    (flag,) = flags("share one VQ-VAE", lambda *_: {"origin": {"prerequisite": "v"}}, (0, 1))
    assert flag.endswith(EVERY)
    assert flags("share one VQ-VAE", lambda _, seed: {"origin": {"prerequisite": f"v{seed}"}}, (0, 1)) == []


@pytest.mark.parametrize(
    ("fact", "begin"),
    [("divided", ""), ("resampled", ""), ("unusual", ""), ("partial", "trained on a part of the data: ")],
)
def test_warnings_about_the_data(flags, sweep: Sweep, tmp_path: Path, fact: str, begin: str):
    origin = {"origin": {fact: "a warning"}}
    found = flags("a warning", lambda label, _: origin if label != LABELS[0] else {})
    assert found == [f"{begin}a warning: 'by position', 'full_model'"]
