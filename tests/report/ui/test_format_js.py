"""The page's numbers and orders (page/format.js), in node."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from processes import finished

PAGE = Path(__file__).parents[3] / "memmlp" / "report" / "ui" / "page"
NODE = shutil.which("node")

pytestmark = pytest.mark.skipif(NODE is None, reason="node is not installed")


def js(code: str) -> Any:
    """What an expression of format.js' functions is."""
    module = (PAGE / "format.js").as_uri()
    made = f"globalThis.document = {{ getElementById: () => null }};\nconst f = await import('{module}');\n"
    ran = finished([str(NODE), "--input-type=module", "-e", f"{made}console.log(JSON.stringify({code}));"])
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout)


def test_nan_errors_come_first_and_are_shown():
    order = "[3, 'nan', undefined, 9, null, 1].sort((a, b) => f.largestFirst(a, b))"
    assert js(f"{order}.map(String)") == ["nan", "null", "9", "3", "1", "undefined"]
    assert js("[f.metricNumber('MPJPE', 'nan'), f.metricNumber('MPJPE', 3)]") == ["nan", "3.00"]


def test_an_error_below_a_tenth_has_two_digits_as_its_difference_has():
    assert js("[0.0034, 0.05, 3.1e-5, 0, 0.25].map(value => f.metricNumber('slide', value))") == [
        "0.0034", "0.050", "3.10e-5".replace("-", "\N{MINUS SIGN}"), "0.00", "0.25",
    ]  # fmt: skip
    assert js("f.effectDigits({mean: 4e-4, holm: .3, level: .05, value: 0.0034})") == 4
    assert js("f.metricNumber('Jitter', 0.034)") == "0.034"


def test_numbers_of_names_and_columns_are_rounded_to_what_differs():
    names = "[...f.shortNames(['lr=0.00991234 · seed 0', 'lr=0.000787654 · seed 0', 'v=1.0']).values()]"
    assert js(names) == ["lr=0.00991 · seed 0", "lr=0.000788 · seed 0", "v=1.0"]
    assert js("[...f.shortNames(['lr=0.12341', 'lr=0.12342']).values()]") == ["lr=0.12341", "lr=0.12342"]
    assert js("[0.123456, 2, 'a'].map(f.columnWords([0.123456, 0.2]))") == ["0.123", "2", "a"]
    assert js("[0.123456, 0.123499].map(f.columnWords([0.123456, 0.123499]))") == ["0.12346", "0.1235"]
    small = "[0.00031623, 0.00031637, 0.001]"
    assert js(f"{small}.map(f.columnWords({small}))") == ["0.0003162", "0.0003164", "0.001"]
