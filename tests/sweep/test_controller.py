"""The controller: a fleet replaces what dies, is no larger than the work, and says why nothing lives."""

from pathlib import Path

import pytest

from memmlp.common.errors import InputError
from memmlp.sweep.controller import MAX_FAILED_STARTS, Fleet


class Dead:
    said: str | None = None

    def alive(self) -> bool:
        return False

    def cancel(self) -> None:
        raise AssertionError

    def complaint(self) -> str | None:
        return self.said


class Unfit(Dead):
    said = "a worker is to have a GPU; torch finds none"


class Living(Dead):
    def __init__(self):
        self.cancelled = False

    def alive(self) -> bool:
        return not self.cancelled

    def cancel(self) -> None:
        self.cancelled = True


class Shelf:
    """An executor whose workers are objects of a given class; it remembers them."""

    gpus = False

    def __init__(self, kind):
        self.kind, self.handles, self.batches = kind, [], []

    def submit(self, work, count=1):
        self.batches.append(count)
        self.handles += [self.kind() for _ in range(count)]
        return self.handles[-count:]


def test_a_fleet_replaces_the_dead_and_is_no_larger_than_the_work(tmp_path: Path):
    shelf = Shelf(Living)
    fleet = Fleet(shelf, lambda: None, 3, tmp_path)
    fleet.keep_workers_running(2)
    assert len(shelf.handles) == 2
    fleet.keep_workers_running(9)
    assert len(shelf.handles) == 3
    shelf.handles[0].cancelled = True
    fleet.keep_workers_running(9)
    assert len(shelf.handles) == 4
    assert shelf.batches == [2, 1, 1]  # those that start at once are started together
    fleet.cancel()
    assert not any(handle.alive() for handle in shelf.handles)


@pytest.mark.parametrize(("kind", "line"), [(Dead, "the reason"), (Unfit, Unfit.said)])
def test_workers_that_never_live_end_the_sweep(tmp_path: Path, kind: type[Dead], line: str):
    fleet = Fleet(Shelf(kind), lambda: None, 2, tmp_path)
    for _ in range(MAX_FAILED_STARTS):
        fleet.keep_workers_running(5)
    with pytest.raises(InputError, match=f"end as soon as they are started: {line}; see"):
        fleet.keep_workers_running(5)
