"""Pinned npm packages: where they are fetched from, that their digest is checked, and what is said if not."""

import base64
import hashlib
import io
import tarfile
from pathlib import Path

import pytest

from memmlp.common import npm
from memmlp.common.errors import InputError
from memmlp.common.npm import Package

FILES = {"package/package.json": b"{}", "package/dist/a.js": b"let a;", "package/dist/b.js": b"let b;"}


def packed(files: dict[str, bytes]) -> bytes:
    made = io.BytesIO()
    with tarfile.open(fileobj=made, mode="w:gz") as archive:
        for name, content in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))
    return made.getvalue()


@pytest.fixture
def package() -> tuple[Package, bytes]:
    content = packed(FILES)
    digest = base64.b64encode(hashlib.sha512(content).digest()).decode()
    return Package("@scope/name", "1.2.3", f"sha512-{digest}"), content


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of its own, and a registry that is a folder."""
    for name in ("NPM_CONFIG_REGISTRY", "npm_config_registry", "NPM_CONFIG_USERCONFIG", npm.FOLDER):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


def serve(folder: Path, content: bytes, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Lay the tarball where a registry has it, and configure that registry."""
    path = folder / "registry" / "@scope" / "name" / "-" / "name-1.2.3.tgz"
    path.parent.mkdir(parents=True)
    path.write_bytes(content)
    monkeypatch.setenv("NPM_CONFIG_REGISTRY", (folder / "registry").as_uri())
    return path


def test_it_is_fetched_once_and_read_member_by_member(package, place, monkeypatch):
    pinned, content = package
    source = serve(place, content, monkeypatch)
    found = npm.read_package_files(pinned, ["dist/a.js", "dist/b.js"])
    assert found == {"dist/a.js": b"let a;", "dist/b.js": b"let b;"}
    source.unlink()
    assert npm.read_package_files(pinned, ["package.json"]) == {"package.json": b"{}"}
    assert [path.name for path in (place / "cache" / "memmlp" / "npm").iterdir()] == ["scope-name-1.2.3.tgz"]
    with pytest.raises(KeyError, match=r"@scope/name@1.2.3 does not have dist/c.js"):
        npm.read_package_files(pinned, ["dist/a.js", "dist/c.js"])


def test_another_file_is_refused_and_not_kept(package, place, monkeypatch):
    pinned, _ = package
    serve(place, packed({"package/dist/a.js": b"evil"}), monkeypatch)
    with pytest.raises(InputError, match=r"^@scope/name@1.2.3: the file from the npm registry"):
        npm.fetch_tarball(pinned)
    assert not list(npm.find_cache_folder().glob("*"))


def test_a_folder_of_tarballs_comes_first(package, place, monkeypatch):
    pinned, content = package
    monkeypatch.setenv(npm.FOLDER, str(place / "given"))
    monkeypatch.setenv("NPM_CONFIG_REGISTRY", (place / "nothing").as_uri())
    with pytest.raises(InputError, match=r"cannot be downloaded .*MEMMLP_NPM.*scope-name-1.2.3.tgz"):
        npm.fetch_tarball(pinned)
    (place / "given").mkdir()
    file = place / "given" / "scope-name-1.2.3.tgz"
    file.write_bytes(content)
    assert npm.fetch_tarball(pinned) == file
    file.write_bytes(content[1:])
    with pytest.raises(InputError, match=r"scope-name-1.2.3.tgz: must be @scope/name@1.2.3"):
        npm.fetch_tarball(pinned)
