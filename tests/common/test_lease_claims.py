"""Of a claim's file only one process makes each number, and nobody sees it half made."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from memmlp.common.lease_claims import Claims
from memmlp.common.liveness import myself

ME = {**myself(), "since": "now"}
OTHER = {**ME, "pid": 1, "born": "1"}


@pytest.fixture(params=["", ".data"])
def claims(request: pytest.FixtureRequest, tmp_path: Path) -> Claims:
    """The claims on a folder, and on one beside its lock, with others beside them."""
    for other in (".other.lease-7", ".lease-x", ".lease-", ".lease-3.tmp"):
        (tmp_path / other).touch()
    return Claims(tmp_path, f"{request.param}.lease-")


def test_a_folder_that_is_not_there_has_no_claims(tmp_path: Path):
    assert Claims(tmp_path / "none", ".lease-").last() is None


@pytest.mark.parametrize("owner", [None, ME])
def test_each_number_is_made_once(claims: Claims, owner: dict | None):
    assert claims.last() is None
    assert claims.make(1, owner)
    assert not claims.make(1, OTHER)
    assert not claims.make(1)
    assert claims.last().owner == (owner or {})
    assert claims.last().free == (owner is None)
    assert claims.last().lives == (True if owner else None)


def test_the_highest_number_counts_and_lower_ones_are_removed(claims: Claims):
    for number in (9, 10, 2):
        assert claims.make(number, {**ME, "number": number})
    assert claims.numbers() == [2, 9, 10]
    assert (claims.last().number, claims.last().owner["number"]) == (10, 10)
    claims.remove_below(10)
    assert claims.numbers() == [10]
    assert len(list(claims.folder.iterdir())) == 5  # and none of the others


def test_nobody_sees_a_claim_before_its_owner_stands_in_it(claims: Claims, monkeypatch):
    """Else it would count as nobody's, and two processes would do the same work."""
    write, seen = os.write, []

    def frozen(handle: int, text: bytes) -> int:
        if not seen:
            seen.append(claims.last())
            assert claims.make(1, OTHER)
        return write(handle, text)

    monkeypatch.setattr("memmlp.common.lease_claims.os.write", frozen)
    assert not claims.make(1, ME)
    assert seen == [None]
    assert claims.last().owner == OTHER
    assert not list(claims.folder.glob("*claim*"))


def test_a_link_whose_answer_was_lost_counts(claims: Claims, monkeypatch):
    link = os.link

    def lost(draft: Path, path: Path) -> None:
        link(draft, path)
        raise FileExistsError

    monkeypatch.setattr("memmlp.common.lease_claims.os.link", lost)
    assert claims.make(1, ME)
    assert claims.last().owner == ME


def test_file_systems_without_links_will_do(claims: Claims, monkeypatch):
    def refuse(*_: object) -> None:
        raise OSError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr("memmlp.common.lease_claims.os.link", refuse)
    assert claims.make(1, ME)
    assert not claims.make(1, OTHER)
    assert claims.last().owner == ME


@pytest.mark.parametrize("text", ['{"pid": 1', "[]", "7"])
def test_a_claim_that_cannot_be_read_is_not_nobodys(claims: Claims, text: str):
    claims.path(4).write_text(text)
    assert claims.last().owner is None
    assert not claims.last().free
