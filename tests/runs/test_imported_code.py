"""What of a user's own a user's module imports."""

from __future__ import annotations

from pathlib import Path

import pytest

from memmlp.runs.imported_code import imported_modules

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
