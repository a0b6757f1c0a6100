"""A mapping of a HallThruster.jl input, emptied key by key: what is left over is not supported."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

NEEDED: Any = object()


class Node:
    """A mapping and its place in the file. `end()` refuses the keys that nobody took."""

    def __init__(self, values: Any, place: str) -> None:
        if not isinstance(values, Mapping):
            raise ValueError(f"{place} must be a mapping: {values!r} came")
        self.place = place
        self._left = dict(values)

    def take(self, key: str, default: Any = NEEDED) -> Any:
        """The value of a key, or the default; raises ValueError if it is needed and not there."""
        if key in self._left:
            return self._left.pop(key)
        if default is NEEDED:
            raise ValueError(f"{self.place} must have the key {key!r}: it is not there")
        return default

    def number(self, key: str, default: Any = NEEDED) -> float:
        """A number."""
        value = self.take(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"{self.place}.{key} must be a number: {value!r} came")
        return float(value)

    def node(self, key: str, default: Any = NEEDED) -> Node:
        """A mapping below this one."""
        return Node(self.take(key, default), f"{self.place}.{key}")

    def at_rest(self, values: Mapping[str, Any]) -> None:
        """Take keys that may be there at one value alone."""
        for key, value in values.items():
            if (came := self.take(key, value)) != value:
                raise ValueError(
                    f"{self.place}.{key} is not supported here but at {value!r}: {came!r} came"
                )

    def idle(self, *keys: str) -> None:
        """Take keys that change nothing here."""
        for key in keys:
            self.take(key, None)

    def end(self) -> None:
        """Raise ValueError for the keys that are left."""
        if self._left:
            raise ValueError(f"{self.place} has keys that are not supported: {sorted(self._left)}")
