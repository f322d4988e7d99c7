"""Declarations are found by name and read without torch, from memmlp and from users' packages."""

import subprocess
import sys
from pathlib import Path

import pytest
from own_package import registers_kept

from memmlp.common.components import (
    SLOTS,
    add_package,
    collect_attribute,
    collect_components,
    find_component,
    list_component_names,
)
from memmlp.common.errors import InputError

TORCH_FREE = """
import sys
from memmlp.common.components import collect_components
settings = [one.settings for one in collect_components().values()]
assert len(settings) >= 50
print("torch" in sys.modules, "omegaconf" in sys.modules)
"""
BASE = """
import torch
from dataclasses import dataclass
from typing import ClassVar
from memmlp.common.components import component
from memmlp.common.settings import Settings, setting

NUMBER = 3
COMPUTED = torch.zeros(3)

@component("memory", "one", version=4, builds="One")
@dataclass
class OneSettings(Settings):
    width: int = setting(default=NUMBER)
    defaults: ClassVar = {"loss": "manual"}

class One(torch.nn.Module):
    def __init__(self, width, extra):
        super().__init__()
        self.width, self.extra = width, extra
"""
DERIVED = """
from dataclasses import dataclass
from typing import ClassVar
from mine.base import One, OneSettings
from memmlp.common.components import component

@component("memory", "two", builds="Two")
@dataclass
class TwoSettings(OneSettings):
    depth: int = 2
    defaults: ClassVar = {"hand": "off"}

class Two(One):
    pass

@component("hand", "keyless")
class Keyless:
    pass
"""


def test_all_settings_are_read_without_torch():
    ran = subprocess.run([sys.executable, "-c", TORCH_FREE], capture_output=True, text=True, check=True)
    assert ran.stdout == "False False\n"


def test_every_shipped_component_can_be_imported_and_others_are_refused():
    for (slot, name), one in collect_components().items():
        assert callable(one.kind), (slot, name)
        assert one.settings.option == f"{slot}={name}"
    assert set(SLOTS) - {"term"} <= {slot for slot, _ in collect_components()}
    with pytest.raises(InputError, match=r"memory=mamba: must be gru or lstm"):
        find_component("memory", "mamba")


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "mine"
    folder.mkdir()
    for name, text in {"__init__": "", "base": BASE, "derived": DERIVED}.items():
        (folder / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    return folder


def test_a_package_adds_components_whose_settings_extend_each_other(package: Path):
    with registers_kept():
        add_package("mine", package)
        one, two = find_component("memory", "one"), find_component("memory", "two")
        assert (one.version, two.version, two.module, two.package) == (4, 1, "mine.derived", "mine")
        assert collect_attribute(two.settings, "defaults") == {"loss": "manual", "hand": "off"}
        assert "mine.base" not in sys.modules
        made = two.build({"name": "two", "width": 5}, extra=7)
        assert (type(made).__name__, made.width, made.extra) == ("Two", 5, 7)
        assert two.make_settings({"name": "two", "depth": 9}).width == 3
        assert find_component("hand", "keyless").kind.__name__ == "Keyless"
        add_package("mine", None)
        assert "one" not in list_component_names("memory")


def test_an_option_is_declared_once_and_settings_need_no_module(package: Path):
    (package / "again.py").write_text('\n@component("memory", "gru")\nclass Mine: pass\n')
    with registers_kept():
        with pytest.raises(InputError, match=r"again\.py: memory=gru exists already"):
            add_package("mine", package)
        assert find_component("memory", "gru").package == "memmlp"
    (package / "again.py").unlink()
    text = BASE.replace("setting(default=NUMBER)", "setting(default=COMPUTED)")
    (package / "base.py").write_text(text)
    with registers_kept():
        add_package("mine", package)
        with pytest.raises(InputError, match=r"base\.py: .*COMPUTED"):
            _ = find_component("memory", "one").settings
