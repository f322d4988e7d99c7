"""A run travels as one file, which is taken in only if it is whole and nothing else."""

import zipfile
from pathlib import Path

import pytest

from memmlp.common.errors import InputError
from memmlp.common.files import file_digest
from memmlp.runs.archive import export_run, import_run
from memmlp.runs.lookup import add_tags, read_notes
from memmlp.runs.run import Run

NAME = "0123456789abcdef"


@pytest.fixture
def run(tmp_path: Path) -> Run:
    made = Run.from_id(tmp_path / "here", NAME)
    made.begin("memmlp", {"seed": 1}, data="d", prerequisite=None)
    made.log(1, {"loss": 1.0})
    made.model.write_bytes(b"weights")
    made.checkpoint.write_bytes(b"large")
    made.finish([made.model.name])
    place = made.deployment("fp32-0")
    place.folder.mkdir(parents=True)
    place.onnx.write_bytes(b"onnx")
    place.finish({"settings": {}})
    (made.folder / "mine.txt").write_text("of the user")
    add_tags(made, ["good"])
    return made


@pytest.fixture
def archive(run: Run, tmp_path: Path) -> Path:
    export_run(run, tmp_path / "run.zip")
    return tmp_path / "run.zip"


def changed(archive: Path, files: dict[str, bytes]) -> Path:
    """Write the archive again with other files."""
    with zipfile.ZipFile(archive) as old:
        content = {name: old.read(name) for name in old.namelist()}
    content |= {f"{NAME}/{name}": data for name, data in files.items()}
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as new:
        for name, data in content.items():
            new.writestr(name, data)
    return archive


def refused(archive: Path, outputs: Path, words: str, **limits: int) -> None:
    with pytest.raises(InputError, match=words):
        import_run(archive, outputs, **limits)
    left = [path for path in outputs.rglob("*") if path.is_file()] if outputs.exists() else []
    assert left == [], "something was left"


def test_it_arrives_as_it_was_without_checkpoint_and_strange_files(run: Run, archive: Path, tmp_path: Path):
    there, new = import_run(archive, tmp_path / "there", file_digest(archive))
    assert new
    assert there.done
    assert (there.verify(), there.config, there.metrics()) == ([], run.config, run.metrics())
    assert there.preferred_onnx.read_bytes() == b"onnx"
    assert read_notes(there).tags == ("good",)
    assert not there.checkpoint.exists()
    assert not (there.folder / "mine.txt").exists()
    assert not import_run(archive, tmp_path / "there")[1]
    assert [path.name for path in there.folder.parent.iterdir()] == [NAME]


def test_only_a_finished_and_unchanged_run_leaves(run: Run, tmp_path: Path):
    config = run.config_path.read_bytes()
    run.config_path.write_text("export:")
    with pytest.raises(InputError, match=r"config\.yaml: cannot be read .export must be a mapping"):
        export_run(run, tmp_path / "x.zip")
    run.config_path.write_bytes(config)
    run.model.write_bytes(b"other")
    with pytest.raises(InputError, match=r"missing or changed files: model\.safetensors"):
        export_run(run, tmp_path / "x.zip")
    run.marker.unlink()
    with pytest.raises(InputError, match="must be finished"):
        export_run(run, tmp_path / "x.zip")
    assert list(tmp_path.glob("*x.zip*")) == []


def test_another_file_than_was_exported_is_refused(archive: Path, tmp_path: Path):
    with pytest.raises(InputError, match="must have the SHA-256"):
        import_run(archive, tmp_path / "there", "0" * 64)
    refused(archive, tmp_path / "there", "--max-gb", max_size=5)


def test_no_other_name_is_unpacked(archive: Path, tmp_path: Path):
    whole = archive.read_bytes()
    for name in (
        "../evil", "/etc/evil", "evaluations/../../evil.json", "evaluations/..json",
        "deployments/../latency.json", "mine.py", "evaluations/a/b.json", "C:evil", "model.pkl",
        ".lease-1", "DONE/x", "evaluations\\x.json",
    ):  # fmt: skip
        archive.write_bytes(whole)
        changed(archive, {name: b"evil"})
        refused(archive, tmp_path / "there", "is not a file of run")
    assert list(tmp_path.rglob("*evil*")) == []


def test_other_compression_is_refused(archive: Path, tmp_path: Path):
    with zipfile.ZipFile(archive) as old, zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_LZMA) as new:
        for name in old.namelist():
            new.writestr(name, old.read(name))
    refused(tmp_path / "a.zip", tmp_path / "there", "must be stored or deflated")


@pytest.mark.parametrize(("files", "words"), [
    ({"model.safetensors": b"WEIGHTS"}, "missing or changed files: model.safetensors"),
    ({"manifest.json": b"{}"}, "must contain a finished run"),
    ({"manifest.json": b'{"id": "0123456789abcdef", "attempts": 5}'}, "attempts must be a list"),
    ({"config.yaml": b"a: &a {b: *a}"}, "config.yaml: cannot be read .has an alias"),
    ({"metrics.jsonl": b'{"step": 1, "phase": [], "time": 1, "values": {}}\n'}, "phase must be text"),
    ({"DONE": b'{"id": "0123456789abcdef", "artifacts": {"../../x": "0"}}'}, "artifacts must be valid"),
    ({f"evaluations/e{n}.json": b"{}" for n in range(1000)}, "at most 1000 files"),
])  # fmt: skip
def test_a_hostile_archive_is_refused(archive: Path, tmp_path: Path, files: dict[str, bytes], words: str):
    refused(changed(archive, files), tmp_path / "there", words)


def test_another_run_of_that_id_stays(run: Run, archive: Path, tmp_path: Path):
    place = Run.from_id(tmp_path / "there", NAME)
    place.begin("memmlp", {}, data="d", prerequisite=None)
    for _ in ("unfinished", "with other weights"):
        with pytest.raises(InputError, match="already exists"):
            import_run(archive, tmp_path / "there")
        place.model.write_bytes(b"other")
        place.finish([place.model.name])
    assert place.config == {}
