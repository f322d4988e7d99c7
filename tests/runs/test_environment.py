"""What a run records of where it ran."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from memmlp.runs import environment as module
from memmlp.runs.environment import environment, user_packages


def test_environment_says_what_ran_without_the_machines_name():
    import platform

    found = environment()
    assert {"version", "git", "python", "packages", "platform", "cpu", "cores", "host"} == set(found)
    assert found["packages"]["torch"].startswith("2.")
    assert platform.node() not in json.dumps(found)


def test_code_that_is_edited_while_it_runs_is_recorded_as_it_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """A worker does many runs with what it imported, whatever its files say later."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "lab_of_mine.py").write_text("A = 1\n")
    before = user_packages(["lab_of_mine"])
    (tmp_path / "lab_of_mine.py").write_text("A = 2\n")
    assert user_packages(["lab_of_mine"]) == before


def test_a_file_is_parsed_only_if_its_bytes_differ(monkeypatch: pytest.MonkeyPatch):
    files = {name: b"A = 1" for name in ("same.py", "comment.py", "changed.py", "mixed.py")}
    monkeypatch.setattr(module, "code_files", lambda packages: files)
    manifest = module.describe_sources()
    manifest["sources"] |= {"mixed.py": module.MIXED, "gone.py": "0" * 12}
    files |= {"comment.py": b"A = 1  # one", "changed.py": b"A = 2", "new.py": b"B = 1"}
    parsed: list[bytes] = []
    digest = module.code_digest
    monkeypatch.setattr(module, "code_digest", lambda code: parsed.append(code) or digest(code))
    assert module.changed_since(manifest) == ["changed.py", "mixed.py"]
    assert sorted(parsed) == [b"A = 1", b"A = 1  # one", b"A = 2"]  # of mixed.py, comment.py and changed.py
    assert module.changed_since({"sources": manifest["sources"]}) == ["changed.py", "mixed.py"]  # older runs
    assert module.changed_since({}) == []


def test_a_patch_is_of_the_code_that_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """So it goes with the commit and the digests, which are taken once, too."""
    for words in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "first"]):
        (tmp_path / "__init__.py").write_text("A = 1\n")
        author = ["-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false"]
        subprocess.run(["git", "-C", str(tmp_path), *author, *words], check=True)
    monkeypatch.setattr(module, "PACKAGE", tmp_path)
    cached = (module._git, module.changes)
    try:
        for one in cached:
            one.cache_clear()
        (tmp_path / "__init__.py").write_text("A = 2\n")
        patch = module.changes()
        assert "+A = 2" in patch
        (tmp_path / "__init__.py").write_text("A = 3\n")
        assert module.changes() == patch
    finally:
        for one in cached:
            one.cache_clear()
