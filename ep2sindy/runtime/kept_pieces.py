"""Finished pieces of work, kept in a folder for a run that continues, or for its other parts."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any, ClassVar

from joblib import Memory

from ep2sindy.runtime.parallel import Function, Part, Results, Workers, refuse_part


class PartDone(Exception):  # noqa: N818, for it is no error
    """A part of the work is done, and other parts are missing: the run ends here, without fault."""


Once = Callable[[Callable[[], Any]], Any]  # does a piece of work, or reads its result back


def at_once(function: Callable[[], Any]) -> Any:
    """Do a piece of work, and keep nothing."""
    return function()


@dataclass(frozen=True, eq=False)
class CachedWorkers:
    """Workers whose finished pieces are kept in a folder, and read back by a run that continues.

    This process reads and writes the pieces, so workers on other machines need not see the folder.
    A piece is named by the number of the call of `run` that it belongs to, and by its own: the
    calls must come in the same order in every run of the same settings. folder: None keeps nothing.
    If the workers have a part (k, n), the first call computes the pieces k - 1, k - 1 + n, ... and
    raises PartDone if others are not kept yet; otherwise, this call and all later ones are whole.
    """

    workers: Workers
    folder: Path | None
    part: ClassVar[Part | None] = None  # that of the workers is respected here
    _calls: Iterator[int] = field(default_factory=count)

    def run(self, function: Function, pieces: Iterable[Any], n_alike: int | None = None) -> Results:
        call = next(self._calls)
        if self.folder is None:
            refuse_part(self.workers.part)
            yield from self.workers.run(function, pieces, n_alike)
            return
        kept, done = KeptPieces(self.folder, call), deque[tuple[int, Any]]()
        own: list[int] = []  # numbers of the pieces that are computed here
        others: list[int] = []  # of those that are left to other parts
        k, n = self.workers.part or (1, 1)

        def waiting() -> Iterator[Any]:
            for number, piece in enumerate(pieces):
                try:
                    done.append((number, kept.read(number)))
                except KeyError:
                    if call == 0 and number % n != k - 1:
                        others.append(number)
                        continue
                    own.append(number)
                    yield piece

        for at, result in self.workers.run(function, waiting(), n_alike):
            kept.write(own[at], result)
            yield own[at], result
            while done:
                yield done.popleft()
        yield from done
        yield from kept.read_others(others, f"part {k} of {n}")

    def once(self, function: Callable[[], Any]) -> Any:
        """The result of one piece of work that is done in this process."""
        call = next(self._calls)
        return KeptPieces(self.folder, call).read_or_do(0, function) if self.folder else function()


class KeptPieces:
    """The pieces of one call that are kept in a folder."""

    def __init__(self, folder: Path, call: int) -> None:
        self.call = call
        self._result = Memory(folder, verbose=0).cache(_computed, ignore=["compute"])

    def read_or_do(self, number: int, compute: Callable[[], Any]) -> Any:
        """The result of a piece; computed and kept if there is none, or a damaged one."""
        return self._result((self.call, number), compute)

    def read(self, number: int) -> Any:
        """The result of a piece. Raises KeyError if there is none, or a damaged one."""
        return self.read_or_do(number, _raise_missing)

    def write(self, number: int, result: Any) -> None:
        self.read_or_do(number, lambda: result)

    def read_others(self, numbers: list[int], name: str) -> Results:
        """The results of other parts' pieces. Raises PartDone if some are missing.

        name: of this part.
        """
        found, missing = [], 0
        for number in numbers:
            try:
                found.append((number, self.read(number)))
            except KeyError:
                missing += 1
        if missing:
            raise PartDone(
                f"{name} is done, and its pieces are kept; {missing} pieces of other parts are "
                "missing. The part that is done last continues with all, or the same command "
                "without parallel.part"
            )
        yield from found


def _computed(piece: tuple[int, int], compute: Callable[[], Any]) -> Any:
    """What a piece gives, by the numbers of its call and its own."""
    return compute()


def _raise_missing() -> Any:
    raise KeyError("this piece is not kept")
