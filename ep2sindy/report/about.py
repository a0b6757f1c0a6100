"""Description of a run for its page: settings, provenance, and the command that repeats it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

DATA = "data: "  # begins the message on what was read

ASIDE = ("experiment", "study", "output", "figures", "thesis", "parallel")


@dataclass(frozen=True)
class About:
    """Description of a run, for its page.

    purpose: of the experiment, in a sentence. asked: settings in words, by name. messages: those
    about the data and the steps of the run. provenance: as in provenance.json. config: the resolved
    config, as text.
    """

    purpose: str
    asked: Mapping[str, str]
    messages: Sequence[str]
    warnings: Sequence[str]
    provenance: Mapping[str, Any]
    config: str

    @property
    def data(self) -> str:
        """What was read, in a line; empty if the run did not say it."""
        return next((text for text in self.messages if text.startswith(DATA)), "")

    @property
    def notes(self) -> list[str]:
        """All other messages."""
        return [text for text in self.messages if text != self.data]

    @property
    def command(self) -> str:
        """The command as typed in a shell, arguments quoted if necessary."""
        from shlex import join

        return join(self.provenance["command"])


def settings_used(settings: Mapping[str, Any], keys: Collection[str]) -> dict[str, str]:
    """The settings that a study uses, in words; unset ones are left out."""
    used = {key: setting_text(settings[key]) for key in settings if key in {*keys} - {*ASIDE}}
    return {key.replace("_", " "): text for key, text in used.items() if text}


def setting_text(value: Any) -> str:
    """Text of a setting, such as `BestSubset (max_terms 4, n_best 2)`; empty if it is not set."""
    placed = by_place("", value)
    name = placed.pop("", "")
    parts = ", ".join(f"{at[1:]} {_number_text(each)}" for at, each in placed.items())
    return f"{name} ({parts})" if name and parts else parts or _number_text(name)


def _number_text(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def by_place(place: str, value: Any) -> dict[str, Any]:
    """Settings by dotted key, `search: BestSubset, search.max_terms: 4`; without unset ones."""
    if isinstance(value, Mapping):
        if "name" in value and value["name"] is None:  # a variable missing in the file
            return {}
        name = str(value.get("_target_", "")).rpartition(".")[2]
        found = {place: name} if name else {}
        for key, each in value.items():
            found |= by_place(f"{place}.{key}", each) if key != "_target_" else {}
        return found
    if isinstance(value, list):
        between = "; " if any(isinstance(each, Mapping) for each in value) else ", "
        return {place: between.join(map(setting_text, value))} if value else {}
    return {place: value} if isinstance(value, int | float | str | bool) else {}


def by_places(settings: Mapping[str, Any], keys: Collection[str]) -> dict[str, Any]:
    """The settings of these keys, each by its dotted key, groups by their name."""
    used = sorted({*keys} & {*settings} - {*ASIDE})
    return {at: value for key in used for at, value in by_place(key, settings[key]).items()}
