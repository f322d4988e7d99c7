"""The browser that tests drive."""

from __future__ import annotations

import pytest
from chromium import Browser

pytestmark = pytest.mark.slow


def test_a_click_comes_although_the_page_replaces_the_element_under_the_mouse_once():
    with Browser() as browser:
        browser.open("about:blank")
        browser.value(
            "document.body.innerHTML = '<button>go</button>'; window.clicks = 0;"
            "addEventListener('click', () => { window.clicks += 1; });"
            "addEventListener('mousedown', () => document.querySelector('button').replaceWith("
            "  Object.assign(document.createElement('button'), {textContent: 'go'})), {once: true});"
        )
        browser.click("button")
        assert browser.value("window.clicks") == 1
