"""A protocol whose list isn't all there: refused, or said wherever its runs are shown."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from cli.conftest import write_random_clip
from command_line import run

from memmlp.runs.lookup import list_runs

TINY = [
    "profile=tiny", "loggers=none", "threads=1", "optim.steps=6", "memory=none", "data.split.val=0.2",
    "export.graph=off",
]  # fmt: skip
S1 = ["data=amass_s1", "data.root=amass", "data.split.folder=lists"]
PART = "amass_s1, 87 % of the list (7 of 8 entries), 2 of 3 subsets (without BioMotionLab_NTroje)"
REFUSED = "data.root=amass: 1 of 8 entries of the list have no clip (MPI_HDM05 1 of 4)"


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A folder with lists of two subsets, all clips of which are there but one, and a sweep."""
    rng = np.random.default_rng(0)
    for subset, now in (("CMU", "CMU"), ("MPI_HDM05", "HDM05")):
        lists = tmp_path / "lists" / subset
        lists.mkdir(parents=True)
        entries = [f"{subset}/0{n}/take_poses.npz\n" for n in range(1, 5)]
        (lists / "train_split.txt").write_text("".join(entries[:3]))
        (lists / "test_split.txt").write_text(entries[3])
        for n in range(1, 5):
            write_random_clip(tmp_path / "amass" / now / f"0{n}" / "take_stageii.npz", rng)
    (tmp_path / "amass" / "HDM05" / "02" / "take_stageii.npz").unlink()
    (tmp_path / "s1.yaml").write_text(yaml.safe_dump({"variants": {"none": []}, "base": ["memory=none"]}))
    return tmp_path


@pytest.mark.parametrize(
    "command",
    [["train", *TINY], ["sweep", "s1.yaml", *TINY, "--workers", "1"], ["tune", *TINY, "loss=manual"]],
)
def test_a_missing_clip_stops_whatever_trains_with_one_line(home, command):
    said = run(home, *command, *S1, code=2)
    assert said.startswith(f"memmlp: {REFUSED}; data.partial=true")
    assert not list_runs(home / "outputs")


@pytest.mark.slow
def test_a_run_on_a_part_says_so_wherever_it_is_shown(home):
    words = [*TINY, *S1, "data.partial=true"]
    assert PART in run(home, "train", *words)
    (made,) = list_runs(home / "outputs")
    assert made.manifest["partial"] == PART
    for command in (["train", *words], ["runs", "show", made.id], ["eval", made.id]):
        assert PART in " ".join(run(home, *command).split())
    flag = f"trained on a part of the data: {PART}: 'none'"
    assert flag in " ".join(run(home, "table", "s1.yaml", *words).split())
