"""The command itself: quick help, exit codes, one line an error, Hydra's own abilities."""

import errno
import signal
import sys
from pathlib import Path
from unittest.mock import Mock

import click
import pytest
from cli.conftest import find_trained
from command_line import TINY, run
from conftest import INT8, Memmlp, one_line
from processes import finished

from memmlp.cli.main import COMMANDS, main
from memmlp.common.errors import InputError, LeaseLost, TrainingDiverged


def test_a_request_to_end_is_a_ctrl_c(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Not so where somebody else's process calls `main`."""
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr("memmlp.cli.train.run_training", lambda cfg: signal.raise_signal(signal.SIGTERM))
    monkeypatch.setattr(sys, "argv", ["memmlp", "train", "profile=tiny"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 130
    assert "interrupted; repeat the command to continue from the last checkpoint" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGTERM) == before
    seen: list[object] = []
    monkeypatch.setattr(
        "memmlp.cli.train.run_training", lambda cfg: seen.append(signal.getsignal(signal.SIGTERM))
    )
    main(["train", "profile=tiny"])
    assert seen == [before]


def test_the_home_folder_in_paths(memmlp: Memmlp, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """As the shell leaves it: in variables of services, and behind the = of an option."""
    seen = Mock()
    monkeypatch.setattr("memmlp.cli.train.run_training", seen)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("MEMMLP_OUTPUTS", "~/out")
    monkeypatch.setattr(sys, "argv", ["memmlp", "train", "profile=tiny"])
    main()
    assert seen.call_args[0][0].paths.outputs == f"{tmp_path}/home/out"
    for words in (["data", "show", "~/a", "--out=~/a.png"], ["train", "--config-dir=~/a"]):
        assert one_line(memmlp(*words), f"{tmp_path}/home/a")
    assert one_line(memmlp("data", "show", str(tmp_path), "--out=a.png", "--body=~/a"), f"{tmp_path}/home/a")


def export(*_: object) -> None:
    """As torch's exporter, which names errors of a module whose import a Ctrl-C cut short."""
    try:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt:
            raise AttributeError("no such attribute of a module that was half imported")  # noqa: B904
    except AttributeError as error:
        raise RuntimeError("failed to export") from error


@pytest.mark.parametrize("fail", [export, click.Abort])  # the latter at a question
def test_every_interruption_is_one_and_only_what_is_resumed_says_so(memmlp: Memmlp, monkeypatch, fail):
    monkeypatch.setattr("memmlp.cli.runs.listing.lookup.list_runs", Mock(side_effect=fail))
    ran = memmlp("runs", "list")
    assert (ran.code, ran.err.strip()) == (130, "memmlp: interrupted")


QUICK = """
import sys
before = set(sys.modules)
from memmlp.cli.main import main
for line in LINES:
    code = 0
    try: main(line)
    except SystemExit as end: code = end.code
    loaded = {name.partition(".")[0] for name in set(sys.modules) - before} - sys.stdlib_module_names
    print("loaded", line[0], code, *sorted(loaded))
"""
LINES = (
    "--help", "eval", "export --out a.onnx", "live", "predict clip --out a", "render --out a.png",
    "web --out site",
)  # fmt: skip


def test_help_and_refusals_of_an_unknown_run_import_nothing_slow(tmp_path: Path):
    lines = [[name, *(["0123"] * (name != "--help")), *more] for name, *more in map(str.split, LINES)]
    ran = finished([sys.executable, "-c", f"LINES = {lines}\n{QUICK}"], cwd=tmp_path)
    told = [line.split()[1:] for line in ran.stdout.splitlines() if line.startswith("loaded")]
    assert told[0][1:] == ["0", "click", "memmlp"], ran.stderr
    assert [(name, code) for name, code, *_ in told[1:]] == [(line[0], "2") for line in lines[1:]]
    assert not any("torch" in loaded for _, _, *loaded in told)
    assert all(f"  {name} " in ran.stdout for name in COMMANDS)


def test_a_second_start_a_typo_and_a_second_export_import_no_torch(home: Path):
    train = ["train", *TINY, INT8]
    run(home, *train)  # prepares the motion of the copied folder
    trained = find_trained(home)
    lines = [train, [*train, "optim.stesp=6"], ["export", trained.id, "--out", "step.onnx"]]
    ran = finished([sys.executable, "-c", f"LINES = {lines}\n{QUICK}"], cwd=home)
    told = [line.split()[2:] for line in ran.stdout.splitlines() if line.startswith("loaded")]
    assert [code for code, *_ in told] == ["0", "2", "0"], ran.stderr
    assert "optim.stesp" in ran.stderr
    deployed = trained.preferred_deployment
    assert f"differs from torch by at most {deployed.record['onnx_parity']:.1e}" in ran.stdout
    assert (home / "step.onnx").read_bytes() == deployed.onnx.read_bytes()
    assert not any({"torch", "onnxruntime"} & {*loaded} for _, *loaded in told)


@pytest.mark.parametrize(("arguments", "words"), [
    (["trian"], ["trian", "did you mean train?", "demo, train, data"]),
    (["--nope"], ["--nope", "memmlp --help"]),
    (["runs", "shwo"], ["shwo"]),
    (["runs", "show"], ["RUN", "memmlp runs show --help"]),
    (["runs", "list", "--nope"], ["--nope", "memmlp runs list --help"]),
    (["runs", "show", "zz"], ["run 'zz'", "a run's folder"]),
    (["train", "profile=tiny", f"paths.outputs={__file__}/a/b"], [f" {__file__}: must be a folder"]),
    (["tune", "search.n_trialz=2"], ["search.n_trialz: no such key", "n_trials?", "objectives"]),
])  # fmt: skip
def test_bad_usage_is_one_line(memmlp: Memmlp, arguments: list[str], words: list[str]):
    assert one_line(memmlp(*arguments), *words)


@pytest.mark.parametrize(("error", "code"), [
    (InputError("a\nb"), 2), (TrainingDiverged("a b"), 1), (LeaseLost("a b"), 1),
    (KeyboardInterrupt(), 130),
    (NotADirectoryError(errno.ENOTDIR, "Not a directory", "/dev/null/runs"), 2),
    (OSError(errno.ENOSPC, "No space left on device", "checkpoint.safetensors"), 2),
    (FileNotFoundError(errno.ENOENT, "No such file or directory", "nope.npz"), 2),
])  # fmt: skip
def test_exit_codes(memmlp: Memmlp, monkeypatch: pytest.MonkeyPatch, error: BaseException, code: int):
    monkeypatch.setattr("memmlp.cli.train.run_training", Mock(side_effect=error))
    ran = memmlp("train", "profile=tiny")
    assert (ran.code, [line[:8] for line in ran.err.splitlines() if line]) == (code, ["memmlp: "])
    assert ran.out == ""


def test_bugs_and_on_request_errors_have_tracebacks(memmlp: Memmlp, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("memmlp.cli.train.run_training", Mock(side_effect=ZeroDivisionError("a bug")))
    with pytest.raises(ZeroDivisionError, match="a bug"):
        memmlp("train")
    monkeypatch.setenv("MEMMLP_TRACEBACK", "1")
    with pytest.raises(InputError, match="unknown command"):
        main(["trian"])


def test_completion(memmlp: Memmlp, monkeypatch: pytest.MonkeyPatch):
    for line, expected in (
        ("memmlp train memory=n", {"memory=no_codes", "memory=none"}),
        ("memmlp train memory=none optim.preci", {"optim.precision="}),
        ("memmlp train memory=none memory.wid", set()), ("memmlp tr", {"train"}), ("memmlp ", set(COMMANDS)),
        ("memmlp runs sh", set()),
    ):  # fmt: skip
        monkeypatch.setenv("COMP_LINE", line)
        ran = memmlp("-sc", "query=bash")
        assert (ran.code, set(ran.out.split())) == (0, expected), line
