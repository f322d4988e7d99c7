"""What of a user's own a user's module imports."""

from __future__ import annotations

from pathlib import Path

import pytest

from memmlp.runs.user_modules import imported_modules, imports_by_computed_names

FILES = {
    "lab/__init__.py": "",
    "lab/mine.py": "import os, memmlp.api, site_module\nfrom . import near\nfrom ..nowhere import x\n",
    "lab/near.py": "if True:\n    import lab.far.thing as t\n    from lab.mine import *\n",
    "lab/far/thing.py": "this is no Python",
    "lab/unused.py": "import lab.mine\n",
    "site-packages/site_module.py": "",
}


def test_only_what_is_imported_of_ones_own_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Whatever it imports in turn, and the packages that it lies in; circles end."""
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    for folder in ("", "site-packages"):
        monkeypatch.syspath_prepend(tmp_path / folder)
    assert imported_modules({"lab.mine": tmp_path / "lab/mine.py"}) == {
        "lab": tmp_path / "lab/__init__.py",
        "lab.far.thing": tmp_path / "lab/far/thing.py",
        "lab.near": tmp_path / "lab/near.py",
    }


@pytest.mark.parametrize(
    ("line", "imported"),
    [
        ("import_module('lab.near')", "lab.near"),
        ("importlib.import_module('.near', __package__)", "lab.near"),
        ("importlib.import_module(f'{__package__}.near')", "lab.near"),
        ("importlib.import_module('..near', package='lab.far')", "lab.near"),
        ("__import__('lab.' + 'near')", "lab.near"),
        ("import_module('os')", None),
        ("import_module(f'torch.{name}')", None),
        ("import_module(f'site_module.{name}')", None),
        ("import_module(f'mine.{name}')", None),  # all files of the package are known
        ("database.exec('select')", None),
        ("import_module(name)", "?"),
        ("import_module(f'lab.{name}')", "?"),
        ("import_module(f'la{name}')", "?"),
        ("import_module('.' + name, __package__)", "?"),
        ("import_module('.near', package)", "?"),
        ("import_module(name='lab')", "?"),
        ("spec_from_file_location('x', path)", "?"),
        ("exec(text)", "?"),
    ],
)
def test_what_is_imported_by_a_call_is_found_or_said_to_be_unknown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str, imported: str | None
):
    for name, text in {**FILES, "lab/mine.py": line, "lab/near.py": "", "mine/__init__.py": ""}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    for folder in ("", "site-packages"):
        monkeypatch.syspath_prepend(tmp_path / folder)
    file = tmp_path / "lab/mine.py"
    found = [name for name in imported_modules({"lab.mine": file}) if name != "lab"]
    unknown = imports_by_computed_names("lab.mine", file, ["mine"])
    assert (found, unknown) == ([imported] if imported not in (None, "?") else [], imported == "?")
