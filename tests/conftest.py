"""What holds for every test."""

import gc
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

from tests.support.browser import Page, browser, chromium
from tests.support.programs import Outcome, Run

if TYPE_CHECKING:
    from groundsbot.fixtures.recording.devices import PtyPort

# A busy machine must not fail a property test.
settings.register_profile("groundsbot", deadline=None)
settings.load_profile("groundsbot")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--long", action="store_true", help="also the full forms of tests that are shortened elsewhere")


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "long: the full form of a shortened test; run by --long")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("--long"):
        items[:] = [item for item in items if item.get_closest_marker("long") is None]


def pytest_collection_finish() -> None:
    gc.freeze()  # what all tests share lives to the end; each collection would go through it again


@pytest.fixture
def calib(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """`groundsbot-calib ARGUMENTS`, as the program."""
    from groundsbot.calib import cli

    return _calling(cli.main, "groundsbot-calib", monkeypatch, capsys)


@pytest.fixture(scope="session")
def window(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """A browser's page."""
    if chromium() is None:
        pytest.skip("no chromium: `apt-get install chromium` (Debian) brings it")
    with browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


def _calling(
    main: Callable[[], None], name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Run:
    def call(*arguments: object) -> Outcome:
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        with pytest.raises(SystemExit) as caught:
            main()
        captured = capsys.readouterr()
        return Outcome(int(caught.value.code or 0), captured.out, captured.err)

    return call


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """`groundsbot-offline ARGUMENTS`, as the program."""
    from groundsbot.offline import cli
    from groundsbot.offline.foundation.jit import COMPILING

    program = _calling(cli.main, "groundsbot-offline", monkeypatch, capsys)

    def call(*arguments: object) -> Outcome:
        outcome = program(*arguments)
        # Whichever test comes first on a fresh machine has the solver compiled.
        return replace(outcome, err=outcome.err.replace(f"{COMPILING}\n", ""))

    return call


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs of three robots in a room that share tags, unrendered, and the truth; to be read only."""
    from groundsbot.fixtures.simulate import simulate

    folder = tmp_path_factory.mktemp("drives") / "room"
    simulate("room", 3, folder, render=False)
    return folder


@pytest.fixture
def plug_in() -> Iterator[Callable[..., "PtyPort"]]:
    """`PtyPort(LINK, ...)`, unplugged after the test."""
    from groundsbot.fixtures.recording.devices import PtyPort

    with ExitStack() as ports:

        def call(link: Path, *, patient: bool = False) -> PtyPort:
            port = PtyPort(link, patient=patient)
            ports.callback(port.unplug)
            return port

        yield call


@pytest.fixture
def signals_back() -> Iterator[None]:
    """Whatever `told_to_end` takes over is given back after the test, and its thread ends."""
    from groundsbot.onboard.process.ending import ENDING_SIGNALS

    handlers = {each: signal.getsignal(each) for each in ENDING_SIGNALS}
    before = signal.set_wakeup_fd(-1)
    threads = set(threading.enumerate())
    yield
    for each, handler in handlers.items():
        signal.signal(each, handler)
    write_fd = signal.set_wakeup_fd(before)
    if write_fd != -1:
        os.close(write_fd)
    for thread in set(threading.enumerate()) - threads:
        if thread.name == "signals":
            thread.join()


@pytest.fixture
def map_to(run: Run, tmp_path: Path) -> Run:
    """`groundsbot-offline map ARGUMENTS -o OUT`."""

    def call(*arguments: object, output: Path | None = None) -> Outcome:
        return run("map", *arguments, "-o", output or tmp_path / "out")

    return call


@pytest.fixture
def refused(map_to: Run, tmp_path: Path) -> Callable[..., str]:
    """The one line of a refusal that leaves nothing behind."""

    def call(*arguments: object, output: Path | None = None) -> str:
        before = sorted(tmp_path.rglob("*"))
        outcome = map_to(*arguments, output=output)
        assert outcome.code == 1
        assert outcome.out == ""
        assert outcome.err.startswith("error: ")
        assert outcome.err.count("\n") == 1
        assert sorted(tmp_path.rglob("*")) == before
        return outcome.err

    return call


@pytest.fixture
def logs(tmp_path: Path) -> dict[str, Path]:
    """Two short drives for `map`, by robot."""
    from tests.support.data.map_cases import make_logs

    return make_logs(tmp_path / "logs")
