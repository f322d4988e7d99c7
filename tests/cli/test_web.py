"""`memmlp web`: what it makes of a run, and what it refuses before it computes."""

import json
from pathlib import Path
from types import SimpleNamespace

import command_line
import pytest
import tiny
from cli.conftest import find_trained

from memmlp.cli.web import describe_network
from memmlp.common.errors import InputError
from memmlp.common.npm import ONNXRUNTIME_WEB, fetch_tarball

pytestmark = pytest.mark.slow


@pytest.mark.long
def test_a_site_to_play_and_wear(home: Path):
    try:
        fetch_tarball(ONNXRUNTIME_WEB)
    except InputError as error:
        pytest.skip(str(error))
    run = find_trained(home).id
    words = ("web", run[:6], "--out", "site", "--clips", "2", "--seconds", "1")
    said = command_line.run(home, *words)
    assert "python -m http.server --directory site" in said
    about = json.loads((home / "site" / "site.json").read_text())
    (network,) = about["networks"]
    assert network["run"] == run
    assert network["remark"].startswith("hardly trained (its steps saw")
    assert f"run {run}: {network['remark']}" in said
    assert [clip["frames"] for clip in about["clips"]] == [60] * len(about["clips"])
    assert network["clips"] == [clip["key"] for clip in about["clips"]]
    size = sum(path.stat().st_size for path in (home / "site").rglob("*") if path.is_file())
    assert size < 25_000_000
    assert f"site: {size / 1e6:.1f} MB" in said


def test_a_network_that_makes_frames_with_later_ones_is_on_no_site():
    model = tiny.baseline("bodiffusion", offline=True, sampling_steps=2, depth=1)
    with pytest.raises(InputError, match=r"model\.offline=true"):
        describe_network(SimpleNamespace(network=lambda: model), [])


def test_what_it_refuses(home: Path):
    run = find_trained(home).id
    for words, line in (
        ([run, run[:5], "--out", "site"], "only once"),
        ([run, "--out", "outputs"], "other content"),
        (["zzz", "--out", "site"], "first digits"),
    ):
        assert line in command_line.run(home, "web", *words, code=2)
    assert not (home / "site").exists()
