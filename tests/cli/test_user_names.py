"""Folders of any name keep their runs."""

import shutil
from pathlib import Path

from begun_runs import complete
from conftest import Memmlp

from memmlp.runs.archive import export_run, import_run
from memmlp.runs.lookup import list_runs
from memmlp.runs.run import Run

NAMES = [
    "...", "-", "--help", "~", "~root", " ", "010", "1e-3", "off", "a.yaml", "x" * 250, "é漢\u202e😀\u200d",
    "'\"\\ $%{}=,[]()", "~:;#&|<>*?!@`^-+._", "a\n\t\x1b", "${", "..a", ":bug:&amp;", "\udc80",
]  # fmt: skip


def test_folders_of_any_name_keep_their_runs(memmlp: Memmlp, tmp_path: Path):
    """Listed, exported and imported."""
    before = tmp_path / "before"
    made = complete(before)
    for name in NAMES:
        outputs = before.rename(tmp_path / name)
        run = Run(outputs / "runs" / made.id)
        assert run.id in memmlp("runs", "list", "--outputs", str(outputs)).out
        file = outputs / f"{name[:99]} run.zip"
        export_run(run, file)
        import_run(file, outputs / "there")
        (moved,) = list_runs(outputs / "there")
        assert (moved.manifest, moved.verify()) == (run.manifest, [])
        shutil.rmtree(outputs / "there")
        file.unlink()
        before = outputs
