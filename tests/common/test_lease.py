"""A folder belongs to one process at a time, and who lost it publishes nothing there."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import random
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import ClassVar

import pytest
from begun_runs import complete
from machines import Clock, Machine, Scheduler, apart, taken
from processes import started, until

from memmlp.common import lease
from memmlp.common.errors import LeaseLost
from memmlp.common.files import atomic_write
from memmlp.common.lease import LEASE, Lease, Lock, current_process, is_alive, publish, temporary_path
from memmlp.runs.evaluation_file import write_report
from memmlp.runs.run import Run

HOLD = """
import json, sys
from pathlib import Path
from memmlp.common.lease import Lock, current_process
with Lock(Path(sys.argv[1])).hold():
    print(json.dumps(current_process()), flush=True)
    sys.stdin.read()
"""


@contextlib.contextmanager
def holding(folder: Path) -> Iterator[tuple[subprocess.Popen, dict]]:
    """A process that holds the folder until its input ends, with its description."""
    line = [sys.executable, "-c", HOLD, str(folder)]
    with started(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        yield holder, json.loads(holder.stdout.readline())


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


@pytest.fixture
def pair(tmp_path: Path, clock: Clock) -> tuple[Holder, Holder]:
    """Two machines, the first of which holds the folder."""
    one, two = Holder("one", tmp_path), Holder("two", tmp_path)
    assert one.take().number == 1
    assert two.take() is None
    return one, two


def test_this_process_is_alive_and_an_earlier_one_with_its_number_is_not(monkeypatch: pytest.MonkeyPatch):
    here = current_process()
    assert is_alive(here) is True
    assert is_alive(here | {"born": "1"}) is False
    monkeypatch.setattr(lease, "compute_process_namespace", lambda: "elsewhere")
    assert is_alive(here) is None


def test_another_process_waits_and_says_for_whom(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    said: list[str] = []
    with holding(tmp_path) as (holder, _):

        def waiting(line: str, **options: object) -> None:
            said.append(line)
            holder.stdin.close()  # only now it lets go

        monkeypatch.setattr(lease, "print", waiting, raising=False)
        with Lock(tmp_path).hold():
            assert len(said) == 1
    assert f"process {holder.pid} since" in said[0]


def test_a_killed_holder_of_this_machine_is_followed_at_once(tmp_path: Path):
    lock = Lock(tmp_path)
    with holding(tmp_path) as (holder, process):
        assert lock.is_held
        with lock.hold(wait=False) as mine:
            assert mine is None
        holder.kill()
        until(lambda: is_alive(process) is False, "it is dead, though its parent has not asked for its end")
        os.kill(holder.pid, 0)  # its number is still taken
        assert lock.is_held is False
        with taken(lock) as mine:
            assert mine.number == 2
            assert lock.is_held


def test_a_dead_holder_of_another_machine_is_followed_after_its_lease(pair, clock: Clock):
    """The times of the file system's files are hours off, and jump while the holder lives: none counts."""
    one, two = pair
    times = itertools.cycle([1e9, 1e9 + 18_000, 1e9 - 18_000])
    for _ in range(6):
        os.utime(one.lock.folder / ".lease-1", (moment := next(times), moment))
        assert two.take() is None
        clock.now += LEASE * 0.9
    assert two.take() is None  # the last sign of life is not yet old enough
    assert two(lambda: two.lock.is_held) is True
    clock.now += LEASE * 0.2
    assert two(lambda: two.lock.is_held) is False
    assert two.take().number == 2


def test_who_wakes_up_superseded_publishes_nothing(pair, tmp_path: Path, clock: Clock):
    one, two = pair
    result = tmp_path / "evaluations" / "stream.json"
    result.parent.mkdir()
    one(atomic_write, result, "one's")
    assert two.take() is None
    clock.now += LEASE + 1
    assert two.take().number == 2
    with pytest.raises(LeaseLost, match="60 s"):
        one(atomic_write, result, "one's, late")
    two(atomic_write, result, "two's")
    one.let_go()
    assert two(lambda: two.lock.is_held) is True  # what the other let go was no longer its own
    two(atomic_write, result, "two's, too")
    two.let_go()
    assert result.read_text() == "two's, too"
    assert two.lock.is_held is None
    atomic_write(result, "nobody's")  # who holds nothing is not checked


@pytest.mark.parametrize("text", ["", '{"pid": 1', "[]"])
def test_a_claim_that_cannot_be_read_expires(tmp_path: Path, clock: Clock, text: str):
    """Its maker may be about to write it, or may have died before it did."""
    (tmp_path / ".lease-4").write_text(text)
    two = Holder("two", tmp_path)
    assert two.take() is None
    clock.now += LEASE + 1
    assert two.take().number == 5


def test_a_folder_beside_its_lock(tmp_path: Path, clock: Clock):
    """What is made as a whole, under a name that it gets at the end; a dead maker's is removed."""
    one, two, place = Holder("one", tmp_path), Holder("two", tmp_path), tmp_path / "data"
    one.lock, two.lock = Lock(tmp_path, "data"), Lock(tmp_path, "data")

    def begin() -> Path:
        unfinished = temporary_path(place)
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
        one(publish, left, place)
    two(publish, two(begin), place)
    assert (place / "half").exists()


def test_a_thread_may_lock_the_folder_as_soon_as_another_one_has_released_it(tmp_path, monkeypatch):
    keep_alive, held, end, written = Lease.keep_alive, threading.Event(), threading.Event(), []

    def follow() -> None:
        with taken(Lock(tmp_path)) as mine:
            held.set()
            assert end.wait(10)
            written.append((mine.number, temporary_path(tmp_path / "result").name))

    thread = threading.Thread(target=follow)

    @contextlib.contextmanager
    def let_the_other_follow(self: Lease) -> Iterator[None]:
        with keep_alive(self):
            yield
        if threading.current_thread() is not thread:
            thread.start()
            assert held.wait(10)

    monkeypatch.setattr(Lease, "keep_alive", let_the_other_follow)
    with taken(Lock(tmp_path)):
        pass
    end.set()
    thread.join()
    [(number, name)] = written
    assert f".lease-{number}." in name


@pytest.mark.parametrize("seed", range(5))
def test_whatever_the_order_nothing_is_published_by_an_earlier_owner(tmp_path, clock, monkeypatch, seed: int):
    """Machines that are frozen at any system call, for longer than a lease or not."""
    dice = random.Random(seed)
    begun: list[int] = []
    published: list[tuple[int, int]] = []
    result = tmp_path / "result"
    scheduler = Scheduler(monkeypatch, clock, dice, pause=LEASE / 2)
    replace = lease.os.replace

    def recorded(unfinished: Path, path: Path) -> None:
        replace(unfinished, path)
        if path == result:
            published.append((lease._leases[tmp_path].number, max(begun)))

    monkeypatch.setattr(lease.os, "replace", recorded)

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


WAYS: dict[str, Callable[[Run], object]] = {
    "checkpoint": lambda run: atomic_write(run.checkpoint, b"late"),
    "DONE": lambda run: run.finish(["model.safetensors"]),
    "manifest": lambda run: run.write_manifest({"late": True}),
    "begin": lambda run: run.begin("memmlp", {}, data="d", prerequisite=None),
    "FAILED": lambda run: run.fail("late"),
    "retry": Run.retry,
    "evaluation": lambda run: write_report(run.evaluation("late-0"), {"mean": {}}),
    "deployment": lambda run: run.deployment("int8-0").finish({"late": True}),
    "log": lambda run: run.log(9, {"loss": 9.0}),
    "picture": lambda run: publish(run.model, run.picture),
    "reset": Run.reset,
    "clear_stages": Run.clear_stages,
}


@contextlib.contextmanager
def losing(folder: Path) -> Iterator[None]:
    """A context in which this process has lost a folder that it held."""
    with Lock(folder).hold() as mine:
        (folder / f".lease-{mine.number + 1}").write_text(json.dumps({"pid": 1, "place": "elsewhere"}))
        try:
            yield
        finally:
            (folder / f".lease-{mine.number + 1}").unlink()


def contents(folder: Path) -> dict[Path, bytes]:
    paths = (path for path in folder.rglob("*") if path.is_file() and ".lease-" not in path.name)
    return {path: path.read_bytes() for path in paths}


@pytest.mark.parametrize("way", WAYS)
def test_nothing_of_a_lost_run_changes(tmp_path: Path, way: str):
    run = complete(tmp_path)
    before = contents(run.folder)
    with losing(run.folder):
        with pytest.raises(LeaseLost):
            WAYS[way](Run(run.folder))
        assert contents(run.folder) == before


def test_a_folder_is_the_same_by_its_other_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "mine").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "mine")
    monkeypatch.chdir(tmp_path)
    with losing(Path("mine")):
        for path in (tmp_path / "link" / "a", Path("link/a"), Path("other/../mine/a")):
            assert ".lease-1." in temporary_path(path).name
            with pytest.raises(LeaseLost):
                publish(tmp_path / "none", path)


def test_only_what_earlier_owners_left_unfinished_is_removed(tmp_path: Path):
    folder = tmp_path / "run"
    (folder / "evaluations").mkdir(parents=True)
    with taken(Lock(folder)):
        left = [temporary_path(place) for place in (folder / "evaluations" / "a", folder / "DONE", folder)]
    others = [temporary_path(folder / "notes"), folder / ".mine.tmp"]
    for path in (*left, *others):
        path.touch()
    with taken(Lock(folder)):
        assert not any(path.exists() for path in left)
        assert all(path.exists() for path in others)
