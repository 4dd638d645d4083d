"""Starts and stops of runs within one program."""

import threading
from collections.abc import Callable

from groundsbot.onboard.page.runs import RunControl


def nothing() -> None:
    pass


def waiting(control: RunControl, on_wait: Callable[[], None] = nothing) -> threading.Event | None:
    return control.next_run(0.01, on_wait)


def test_the_first_run_starts_by_itself_and_is_not_repeated() -> None:
    stop = threading.Event()
    control = RunControl(stop)
    first = waiting(control)
    assert first is not None
    assert not control.start()  # one goes on
    first.set()  # it ends by itself
    waits: list[int] = []

    def count() -> None:
        waits.append(1)
        if len(waits) == 3:
            stop.set()

    assert waiting(control, count) is None
    assert len(waits) >= 3


def test_a_run_is_stopped_and_another_one_started() -> None:
    control = RunControl(threading.Event())
    first = waiting(control)
    assert first is not None
    assert control.stop()
    assert first.is_set()
    assert not control.stop()  # it is ending
    assert control.start()  # after its end
    assert control.stop()  # takes that back
    assert control.start()
    second = waiting(control)
    assert second is not None
    assert not second.is_set()


def test_the_end_of_the_program_ends_the_run() -> None:
    stop = threading.Event()
    control = RunControl(stop)
    run = waiting(control)
    assert run is not None
    stop.set()
    assert run.wait(60.0)
    assert not control.goes_on
    assert waiting(control) is None
