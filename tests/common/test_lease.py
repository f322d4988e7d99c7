"""A folder belongs to one process at a time, whatever the file system's locks are worth."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import itertools
import os
import random
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import ClassVar

import pytest
from machines import Clock, Machine, Scheduler, apart, taken, without_locks
from processes import started

from memmlp.common import lease, lease_fences
from memmlp.common.errors import LeaseLost
from memmlp.common.files import atomic_write
from memmlp.common.lease import LEASE, Lease, Lock
from memmlp.common.liveness import myself

HOLD = """
import sys
from pathlib import Path
from memmlp.common.lease import Lock
with Lock(Path(sys.argv[1])).hold():
    print("held", flush=True)
    sys.stdin.read()
"""


@contextlib.contextmanager
def holding(folder: Path) -> Iterator[subprocess.Popen]:
    """A process that holds the folder until its input ends."""
    line = [sys.executable, "-c", HOLD, str(folder)]
    with started(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout.readline() == b"held\n"
        yield holder


class Holder:
    """A machine that holds a folder until it is told to let go, or the test ends."""

    every: ClassVar[list[Holder]] = []

    def __init__(self, name: str, folder: Path):
        self.machine, self.lock, self.stack = Machine(name), Lock(folder), ExitStack()
        self.every.append(self)

    def take(self) -> Lease | None:
        return self.machine(lambda: self.stack.enter_context(self.lock.hold(wait=False)))

    def let_go(self) -> None:
        self.machine(self.stack.close)

    def __call__(self, action: Callable, *arguments: object) -> object:
        return self.machine(action, *arguments)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Iterator[Clock]:
    yield apart(monkeypatch)
    while Holder.every:
        Holder.every.pop().let_go()


def test_another_process_waits_and_says_for_whom(tmp_path: Path):
    said: list[str] = []
    with holding(tmp_path) as holder:

        def waiting(line: str) -> None:
            said.append(line)
            holder.stdin.close()  # only now it lets go

        with Lock(tmp_path).hold(waiting):
            assert len(said) == 1
    assert f"process {holder.pid} since" in said[0]


@pytest.mark.parametrize("locks", [True, False])
def test_a_killed_holder_of_this_machine_is_followed_at_once(tmp_path: Path, monkeypatch, locks: bool):
    if not locks:
        without_locks(monkeypatch)
    lock = Lock(tmp_path)
    with holding(tmp_path) as holder:
        assert lock.held
        with lock.hold(wait=False) as mine:
            assert mine is None
        holder.kill()
        assert lock.held is False or holder.wait()  # it may take a moment to die
        holder.wait()
        with taken(lock) as mine:
            assert mine.number == 2
            assert lock.held


def test_numbers_grow_and_one_claim_stays(tmp_path: Path):
    lock = Lock(tmp_path)
    for turn in range(3):
        with taken(lock) as outer, taken(Lock(tmp_path)) as inner:
            assert inner is outer
            assert outer.number == 2 * turn + 1
        assert lock.held is None
        assert [path.name for path in tmp_path.glob(".lease-*")] == [f".lease-{2 * turn + 2}"]


def test_a_process_number_that_another_process_got_is_dead(tmp_path: Path):
    lock = Lock(tmp_path)
    lock.claims.make(1, {**myself(), "born": "1", "since": "now"})
    assert lock.held is False
    with taken(lock) as mine:
        assert mine.number == 2


def test_a_dead_holder_of_another_machine_is_followed_after_its_lease(tmp_path: Path, clock: Clock):
    one, two = Holder("one", tmp_path), Holder("two", tmp_path)
    assert one.take().number == 1
    for _ in range(5):
        assert two.take() is None
        assert two(lambda: two.lock.held) is True
        clock.now += LEASE / 4
    assert two(lambda: two.lock.held) is False
    assert two.take().number == 2


def test_a_holder_that_shows_life_keeps_its_folder(tmp_path: Path, clock: Clock):
    one, two = Holder("one", tmp_path), Holder("two", tmp_path)
    mine = one.take()
    for _ in range(10):
        assert two.take() is None
        one(mine.check)
        clock.now += LEASE * 0.9


@pytest.mark.parametrize("hours", [-5, 5])
def test_clocks_of_other_machines_count_for_nothing(tmp_path: Path, clock: Clock, hours: int):
    """The times of the file system's files are hours off, and jump while the holder lives."""
    one, two = Holder("one", tmp_path), Holder("two", tmp_path)
    mine = one.take()
    claim = mine.claims.path(mine.number)
    times = itertools.cycle([1e9, 1e9 + 3600 * hours])
    for _ in range(6):
        os.utime(claim, (moment := next(times), moment))
        assert two.take() is None
        clock.now += LEASE * 0.9
    assert two.take() is None  # the last sign of life is not yet old enough
    clock.now += LEASE * 0.2
    assert two.take().number == 2


def test_an_observer_that_was_frozen_itself_takes_nothing(tmp_path: Path, clock: Clock, monkeypatch):
    """It slept between its look at the holder, who lives, and what it made of it."""
    one, two = Holder("one", tmp_path), Holder("two", tmp_path)
    mine = one.take()
    assert two.take() is None
    last = two.lock.claims.last

    def sleepily() -> object:
        seen = last()
        clock.now += 10 * LEASE
        one(mine.check)
        return seen

    monkeypatch.setattr(two.lock.claims, "last", sleepily)
    assert two.take() is None
    assert two.take() is None


def test_who_wakes_up_superseded_publishes_nothing(tmp_path: Path, clock: Clock):
    one, two = Holder("one", tmp_path), Holder("two", tmp_path)
    result = tmp_path / "evaluations" / "stream.json"
    result.parent.mkdir()
    mine = one.take()
    one(atomic_write, result, "one's")
    assert two.take() is None
    clock.now += LEASE + 1
    assert two.take().number == 2
    with pytest.raises(LeaseLost, match="took it over, for this one stood still for longer than 60 s"):
        one(atomic_write, result, "one's, late")
    assert mine.lost
    two(atomic_write, result, "two's")
    one.let_go()
    assert two(lambda: two.lock.held) is True  # what the other let go was no longer its own
    two(atomic_write, result, "two's, too")
    two.let_go()
    assert result.read_text() == "two's, too"
    assert two.lock.held is None
    atomic_write(result, "nobody's")  # who holds nothing is not fenced


def test_a_later_claim_counts_before_its_maker_did_anything(tmp_path: Path, clock: Clock):
    one = Holder("one", tmp_path)
    one.take()
    Lock(tmp_path).claims.make(2, {"since": "now"})
    with pytest.raises(LeaseLost):
        one(atomic_write, tmp_path / "DONE", "late")


def test_a_freeze_between_check_and_rename_publishes_nothing(tmp_path: Path, clock: Clock, monkeypatch):
    one, two = Holder("one", tmp_path), Holder("two", tmp_path)
    result, replace, taken_over = tmp_path / "DONE", os.replace, []

    def frozen(unfinished: Path, path: Path) -> None:
        if not taken_over:
            assert two.take() is None
            clock.now += LEASE + 1
            taken_over.append(two.take())
        replace(unfinished, path)

    one.take()
    monkeypatch.setattr("memmlp.common.lease_fences.os.replace", frozen)
    with pytest.raises(LeaseLost):
        one(atomic_write, result, "late")
    assert taken_over[0].number == 2
    assert not result.exists()
    assert not list(tmp_path.glob(".*.tmp"))


def test_a_claim_that_was_decided_on_long_ago_is_given_up(tmp_path: Path, clock: Clock, monkeypatch):
    """A process sees a free folder, and sleeps while others have it, one after another."""
    one, two = Holder("one", tmp_path), Holder("two", tmp_path)
    make = one.lock.claims.make

    def late(number: int, owner: dict) -> bool:
        assert two.take().number == 1
        two.let_go()
        assert two.take().number == 3
        return make(number, owner)

    monkeypatch.setattr(one.lock.claims, "make", late)
    assert one.take() is None
    two(atomic_write, tmp_path / "DONE", "two's")
    assert [path.name for path in tmp_path.glob(".lease-*")] == [".lease-3"]


def test_a_claim_whose_maker_died_before_it_wrote_it_is_nobodys(tmp_path: Path, clock: Clock):
    (tmp_path / ".lease-4").touch()
    assert Holder("two", tmp_path).take().number == 5


@pytest.mark.parametrize("name", ["", "data"])
def test_the_next_owner_removes_claims_in_the_making(tmp_path: Path, name: str):
    lock = Lock(tmp_path, name)
    draft = lock.claims._draft(1)
    lock.claims.make(1)
    draft.touch()
    with taken(lock) as mine:
        assert mine.number == 2
        assert not draft.exists()


@pytest.mark.parametrize("text", ['{"pid": 1', "[]", "7"])
def test_a_claim_that_cannot_be_read_expires(tmp_path: Path, clock: Clock, text: str):
    (tmp_path / ".lease-4").write_text(text)
    two = Holder("two", tmp_path)
    assert two.take() is None
    clock.now += LEASE + 1
    assert two.take().number == 5


@pytest.mark.parametrize("code", [errno.ENOSYS, errno.ENOLCK])
def test_file_systems_without_locks_will_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int):
    def refuse(*_: object) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with taken(Lock(tmp_path)) as mine:
        assert mine.number == 1


def test_the_kernels_lock_alone_keeps_others_away(tmp_path: Path):
    """Of a process of an earlier version, which made no claims."""
    with open(tmp_path / ".lock", "wb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with Lock(tmp_path).hold(wait=False) as mine:
            assert mine is None
    with taken(Lock(tmp_path)) as mine:
        assert mine.number == 1


def test_a_full_disk_lets_go_by_the_lease(tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch):
    one, two = Holder("one", tmp_path), Holder("two", tmp_path)
    one.take()
    with monkeypatch.context() as full:

        def refuse(*_: object) -> bool:
            raise OSError(errno.ENOSPC, "No space left on device")

        full.setattr(one.lock.claims, "make", refuse)
        one.let_go()
    assert two.take() is None
    clock.now += LEASE + 1
    assert two.take().number == 2


def test_who_settles_waits_until_the_holder_shows_life_or_its_lease_is_over(tmp_path, clock, monkeypatch):
    one, two, said = Holder("one", tmp_path), Holder("two", tmp_path), []
    mine = one.take()
    pauses: list[float] = []
    monkeypatch.setattr(lease.time, "sleep", lambda s: (pauses.append(s), one(mine.check)))
    two(two.lock.settle, said.append)
    assert len(pauses) == 1
    assert "looking whether process" in said[0]
    assert "of another machine since" in said[0]
    assert two.take() is None
    monkeypatch.setattr(lease.time, "sleep", lambda s: setattr(clock, "now", clock.now + 7))
    two(two.lock.settle, said.append)
    assert two.take().number == 2


def test_a_folder_beside_its_lock(tmp_path: Path, clock: Clock):
    """What is made as a whole, under a name that it gets at the end; a dead maker's is removed."""
    one, two, place = Holder("one", tmp_path), Holder("two", tmp_path), tmp_path / "data"
    one.lock, two.lock = Lock(tmp_path, "data"), Lock(tmp_path, "data")

    def begin() -> Path:
        unfinished = lease_fences.temporary(place)
        unfinished.mkdir()
        (unfinished / "half").touch()
        return unfinished

    assert one.take()
    left = one(begin)
    assert two.take() is None
    clock.now += LEASE + 1
    assert two.take()
    assert not left.exists()
    with pytest.raises(LeaseLost):
        one(lease_fences.publish, left, place)
    two(lease_fences.publish, two(begin), place)
    assert (place / "half").exists()


@pytest.mark.parametrize("seed", range(16))
def test_whatever_the_order_nothing_is_published_by_an_earlier_owner(tmp_path, clock, monkeypatch, seed: int):
    """Machines that are frozen at any system call, for longer than a lease or not."""
    dice = random.Random(seed)
    begun: list[int] = []
    published: list[tuple[int, int]] = []
    result = tmp_path / "result"
    scheduler = Scheduler(monkeypatch, clock, dice, pause=LEASE / 2)
    replace = lease_fences.os.replace

    def recorded(unfinished: Path, path: Path) -> None:
        replace(unfinished, path)
        if path == result:
            published.append((lease_fences._FENCES[tmp_path].number, max(begun)))

    monkeypatch.setattr(lease_fences.os, "replace", recorded)

    def work() -> None:
        for _ in range(12):
            with contextlib.suppress(LeaseLost), Lock(tmp_path).hold(wait=False) as mine:
                if mine:
                    begun.append(mine.number)
                    for number in range(3):
                        atomic_write(result, f"{mine.number} {number}")

    scheduler.run({name: work for name in ("one", "two", "three")})
    assert len(set(begun)) == len(begun) > 0
    assert published
    assert all(owner == newest for owner, newest in published)
    assert not list(tmp_path.glob(".*.tmp"))
