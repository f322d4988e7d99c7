"""The shipped networks: found by name, and as their cards say."""

import itertools
import json
import re
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest
import yaml

from memmlp.common.errors import InputError
from memmlp.common.files import file_digest
from memmlp.config.open_run import open_existing_run
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.deploy.parity import stream_onnx
from memmlp.evaluation.modes import measure_clip
from memmlp.motion.body import load_rest_joints
from memmlp.motion.importing.import_folder import import_folder
from memmlp.motion.motion_source import ShippedMotion
from memmlp.runs.lookup import find_run, find_shipped_clip, list_shipped, read_card

NAMES = list_shipped()
ARCHIVE = Path(__file__).parents[3] / "shared" / "data" / "cmu-asfamc" / "cmu-asfamc.tar.xz"


def test_names_are_found_and_unknown_ones_refused(tmp_path: Path):
    assert NAMES == ["mem_mlp", "recurrent_poser"]
    for name in NAMES:
        assert find_run(tmp_path, name).done
    with pytest.raises(InputError, match="recurrent_poser"):
        find_run(tmp_path, "recurrent_poser_2")


def test_a_shipped_network_has_no_training_clips():
    with pytest.raises(InputError, match=r"^cmu_86_01: .*; train clips need a run of your own$"):
        ShippedMotion(find_shipped_clip(), load_rest_joints("builtin")).open("train")


@pytest.mark.parametrize("name", NAMES)
def test_files_and_persons_are_those_of_the_card(name: str, tmp_path: Path):
    run, card = find_run(tmp_path, name), read_card(name)
    files = {path.name: path for path in run.folder.rglob("*") if path.suffix in (".onnx", ".safetensors")}
    assert {file: file_digest(path) for file, path in files.items()} == {
        file: facts["sha256"] for file, facts in card["files"].items()
    }
    assert not run.verify()
    train, val, test = (set(card["persons"][part]) for part in ("train", "val", "test"))
    assert not (train | val) & test
    assert not train & val
    subject = find_shipped_clip().stem.split("_")[1]
    assert f"cmu-{subject}" in test
    text = "".join(p.read_text() for p in run.folder.rglob("*") if p.suffix in (".json", ".jsonl", ".yaml"))
    assert not re.search(r'[\s":]/\w', text)  # no absolute path
    assert yaml.safe_load(run.config_path.read_text())["data"]["root"] == "outputs/data/persons"


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param("mem_mlp", marks=pytest.mark.long), "recurrent_poser"])
def test_errors_on_the_clip_are_those_of_the_card(name: str, tmp_path: Path):
    """Of torch and of ONNX Runtime."""
    opened = open_existing_run(find_run(tmp_path, name))
    expected, clip = read_card(name)["clip"]["errors"], opened.test.read_clip(0)
    network = opened.network()
    exported = stream_onnx(OnnxStream(opened.run.preferred_onnx), clip)
    torch = opened.experiment.evaluation.report(network, opened.test, "stream")["mean"]
    for found in (measure_clip(network.normalizer, exported, clip), torch):
        for branch, metrics in expected.items():
            for metric, value in metrics.items():
                assert float(found[branch][metric]) == pytest.approx(value, rel=0.01, abs=0.01), (
                    branch,
                    metric,
                )


@pytest.mark.slow
def test_errors_on_a_test_persons_take_are_those_of_the_evaluation(tmp_path: Path):
    """The take is imported from the database; the card's errors are means over such takes."""
    if not ARCHIVE.exists():
        pytest.skip(f"needs {ARCHIVE.name}, which is not part of the project")
    with tarfile.open(ARCHIVE, "r|xz") as archive:
        wanted = (entry for entry in archive if entry.name.endswith(("/39.asf", "/39_08.amc")))
        for entry in itertools.islice(wanted, 2):
            archive.extract(entry, tmp_path / "sets", filter="data")
    import_folder(tmp_path / "sets", tmp_path / "clips")
    (path,) = (tmp_path / "clips").rglob("*.npz")
    clip = ShippedMotion(path, load_rest_joints("builtin")).open("test").read_clip(0)
    for name in NAMES:
        opened = open_existing_run(find_run(tmp_path, name))
        (report,) = (json.loads(path.read_text()) for path in opened.run.evaluations.glob("stream-*.json"))
        (row,) = (row for row in report["clips"] if row["name"].endswith("/39_08"))
        predicted = stream_onnx(OnnxStream(opened.run.preferred_onnx), clip)
        found = measure_clip(opened.network().normalizer, predicted, clip)["rotation"]
        for metric, value in row["rotation"].items():
            assert float(found[metric]) == pytest.approx(float(value), rel=0.01, abs=1e-4), (name, metric)


@pytest.mark.slow
def test_a_stream_by_name_needs_no_torch():
    code = "import memmlp, sys; print(memmlp.Stream('recurrent_poser')); assert 'torch' not in sys.modules"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "recurrent_poser" in ran.stdout


@pytest.mark.slow
def test_eval_shows_the_card_and_measures_only_with_data(memmlp, tmp_path: Path):
    shown = memmlp("eval", "recurrent_poser", "--outputs", str(tmp_path))
    mean = read_card("recurrent_poser")["errors"]["rotation"]["MPJPE"][0]
    assert (shown.code, f"{mean:.2f}" in shown.out) == (0, True), shown.err
    again = memmlp("eval", "recurrent_poser", "--again", "--outputs", str(tmp_path))
    assert again.code == 2
    assert "data.root" in again.err
    assert "position" not in shown.out  # its errors would be those of the rotation branch again
    other = memmlp("eval", "recurrent_poser", f"data.root={tmp_path}", "--outputs", str(tmp_path))
    assert "run recurrent_poser: needs the data of its training" in other.err


def test_a_card_has_only_branches_of_its_network(memmlp):
    branches = {name: "| position |" in memmlp("models", name).out for name in NAMES}
    assert branches == {"mem_mlp": True, "recurrent_poser": False}
