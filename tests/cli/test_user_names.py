"""Names of folders, sweep files and packages from users: kept as they are, or refused in one line."""

import random
import shutil
from pathlib import Path

from begun_runs import complete
from conftest import Memmlp

from memmlp.common.errors import InputError
from memmlp.config.compose_plan import find_sweep, get_sweep_folder
from memmlp.runs.archive import export_run, import_run
from memmlp.runs.lookup import list_runs
from memmlp.runs.run import Run

PIECES = [
    *"abz019é漢\u202e😀\u200d'\"\\ $%{}=,[]()~:;#&|<>*?!@`^-+._\n\t\x1b", "${", "off", "null", "..", ":bug:",
    "&amp;", "\udc80",
]  # fmt: skip
EDGES = [".", "..", "...", "-", "--help", "~", "~root", " ", "010", "1e-3", "off", "a.yaml", "x" * 250]


def make_names(count: int = 200) -> list[str]:
    dice = random.Random(0)
    made = ["".join(dice.choices(PIECES, k=dice.randint(1, 12))) for _ in range(count)]
    return list(dict.fromkeys([*EDGES, *made]))


def test_sweep_files_of_any_name_have_a_folder_each(tmp_path: Path):
    (tmp_path / "sweeps").mkdir()
    folders: dict[Path, str] = {}
    for name in make_names():
        file = tmp_path / f"{name}.yaml"
        file.write_text("variants: {a: [], b: [memory=none]}\nseeds: [0]\n")
        try:
            sweep = find_sweep(str(file))
        except InputError:
            assert not name.isprintable() or not name.strip(". ") or len(name) > 200
            continue
        folder = get_sweep_folder(sweep, tmp_path)
        folder.mkdir()  # and no other sweep has it
        assert folder.resolve().parent == tmp_path / "sweeps"
        folders[folder] = sweep.name
    assert len(folders) > 100


def test_folders_of_any_name_keep_their_runs(memmlp: Memmlp, tmp_path: Path):
    """Listed, exported and imported."""
    before = tmp_path / "before"
    made = complete(before)
    for number, name in enumerate(name for name in make_names() if name not in (".", "..")):
        outputs = before.rename(tmp_path / name)
        run = Run(outputs / "runs" / made.id)
        if number < len(EDGES):
            assert run.id in memmlp("runs", "list", "--outputs", str(outputs)).out
        file = outputs / f"{name[:99]} run.zip"
        export_run(run, file)
        import_run(file, outputs / "there")
        (moved,) = list_runs(outputs / "there")
        assert (moved.manifest, moved.verify()) == (run.manifest, [])
        shutil.rmtree(outputs / "there")
        file.unlink()
        before = outputs
