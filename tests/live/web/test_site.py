"""The site's folder: what is in it, that it is whole or not there, and that nothing else is overwritten."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from live.web.conftest import PERSON, Made

from memmlp.common import npm
from memmlp.common.errors import InputError
from memmlp.live.rotations import quaternion_to_matrix
from memmlp.live.spaces import SPACES
from memmlp.live.web.site import NUMBERS, Site, check_site_folder, pack_clip

NOTHING = Site(networks=[], clips=[])


@pytest.mark.slow
def test_everything_that_the_page_names_is_there_and_nothing_elsewhere(site: Made):
    about = json.loads((site.folder / "site.json").read_text())
    named = [entry["play"] for entry in about["networks"]] + [clip["file"] for clip in about["clips"]]
    assert [name for name in named if not (site.folder / name).is_file()] == []
    imports = re.compile(r"""(?:from|import\()\s*['"](\./[^'"$]+)['"]""")
    for path in site.folder.glob("*.js"):
        for name in imports.findall(path.read_text()):
            assert (path.parent / name).is_file(), f"{path.name} imports {name}"
    # The service worker keeps every file.
    files = {path.relative_to(site.folder).as_posix() for path in site.folder.rglob("*") if path.is_file()}
    worker = (site.folder / "sw.js").read_text()
    head = re.match(r'const VERSION = "(\w{16})";\nconst FILES = (\[.*\]);\n', worker)
    assert head is not None
    assert set(json.loads(head[2])) == files - {"sw.js"}
    # Addresses are relative; the policy allows no other host.
    page = (site.folder / "index.html").read_text()
    assert "POLICY" not in page
    assert "default-src 'none'" in page
    own = [path for path in site.folder.glob("*") if path.suffix in (".js", ".html", ".css")]
    assert [path.name for path in own if re.search(r"https?://", path.read_text())] == []
    assert not re.search(r"""(?:src|href)=["']/""", page)


def test_nothing_else_is_overwritten(tmp_path: Path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match="other content"):
        NOTHING.write(tmp_path)
    with pytest.raises(InputError, match="is a file"):
        check_site_folder(tmp_path / "thesis.tex")
    with pytest.raises(InputError, match="does not exist"):
        check_site_folder(tmp_path / "none" / "site")
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_without_the_packages_an_earlier_site_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("NPM_CONFIG_REGISTRY", (tmp_path / "nowhere").as_uri())
    monkeypatch.delenv(npm.FOLDER, raising=False)
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "site.json").write_text('{"packages": {}}')
    with pytest.raises(InputError, match="onnxruntime-web@"):
        NOTHING.write(tmp_path / "site")
    assert [path.name for path in tmp_path.iterdir()] == ["site"]
    assert [path.name for path in (tmp_path / "site").iterdir()] == ["site.json"]


def test_it_is_the_middle_of_the_clip_in_the_page_s_axes():
    frames, space = PERSON.frames.numpy(), SPACES["openxr"]
    clip, whole = pack_clip("walk", frames, 1.0), pack_clip("a", frames, 9.0)
    assert (clip.name, clip.frames, whole.frames) == ("walk", 60, len(frames))
    assert whole.key == pack_clip("b", frames, 9.0).key != pack_clip("a", frames[1:], 9.0).key
    numbers = np.frombuffer(clip.content, "<f4").reshape(60, NUMBERS)
    first = (len(frames) - 60) // 2
    middle = slice(first + 1, first + 61)  # frames have no first moment
    positions = space.convert_positions_from_amass(PERSON.positions[middle])
    np.testing.assert_allclose(numbers[:, :9].reshape(-1, 3, 3), positions, atol=1e-6)
    rotations = quaternion_to_matrix(numbers[:, 9:21].reshape(-1, 4).astype(float)).reshape(-1, 3, 3, 3)
    expected = space.convert_rotations_from_amass(PERSON.rotations[middle])
    np.testing.assert_allclose(rotations, expected, atol=1e-5)
    joints = space.convert_positions_from_amass(frames[first : first + 60, -66:].reshape(-1, 22, 3))
    np.testing.assert_allclose(numbers[:, 21:].reshape(-1, 22, 3), joints, atol=1e-6)
