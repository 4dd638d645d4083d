"""Workers of a cluster that are killed when a function is called."""

from collections.abc import Callable, Sequence
from typing import Any

from groundsbot.offline.foundation.workers import Handle, TaskWorkers


class DyingWorkers(TaskWorkers):
    """Those of a cluster, of which one is killed once, when a function of some name was called n times."""

    def __init__(self, workers: TaskWorkers, name: str, n: int, kill: Callable[[], None]) -> None:
        self._workers, self._name, self._kill = workers, name, kill
        self._n_left = n

    @property
    def has_killed(self) -> bool:
        return self._n_left <= 0

    def call(self, name: str, function: Callable[..., object], *arguments: object) -> Handle:
        handle = self._workers.call(name, function, *arguments)
        if name == self._name:
            self._n_left -= 1
            if self._n_left == 0:
                self._kill()
        return handle

    def results(
        self, submit: Callable[[int], Handle], names: Sequence[str], tick: Callable[[], None]
    ) -> tuple[list[Handle], list[Any]]:
        return self._workers.results(submit, names, tick)
