"""Runs that go on where they were broken off: what pieces depend on, and what is said."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ep2sindy.data.steps import files_of
from ep2sindy.operating.file_names import FilePattern
from ep2sindy.report.run import Run
from ep2sindy.runtime.files import fingerprint
from ep2sindy.runtime.kept import Kept, KeptWorkers
from ep2sindy.runtime.parallel import ONE_BY_ONE, Workers
from ep2sindy.trust.user_code import PACKAGE, own_source

# Settings of every study that do not change a piece's result; they may differ when a broken run is
# continued.
ALWAYS_ASIDE = {
    "output", "parallel", "keep", "experiment", "study", "verbose", "figures", "labels", "thesis",
}  # fmt: skip


def pieces_key(settings: Mapping[str, Any], *, aside: Collection[str] = ()) -> str:
    """Hash of everything that a piece's result depends on: settings, their files, the code.

    aside: keys of settings that it does not depend on, besides those of every study.
    """
    left = ALWAYS_ASIDE | {*aside}
    decisive = {key: value for key, value in settings.items() if key not in left}
    decisive["files"] = [
        (str(path), each.stat().st_size, each.stat().st_mtime_ns)
        for text in _files_named([settings.get(key) for key in ("data", "prepare", "points")])
        if (path := Path(text)).exists()
        for each in (path, *sorted(path.rglob("*")))  # a Zarr store is a folder
    ]
    found = json.dumps(decisive, sort_keys=True)
    for sources in (PACKAGE, *own_sources(settings)):
        found = fingerprint(found, sources=sources)
    return found


def own_sources(settings: Mapping[str, Any]) -> list[Path]:
    """The user's own code: modules and packages other than ours that the settings name."""
    names = [text for key, text in texts(settings) if key in ("_target_", "study") and "." in text]
    found = {own_source(name) for name in names if not name.startswith("ep2sindy.")}
    return sorted(path for path in found if path is not None)


def texts(settings: object, key: str = "") -> Iterator[tuple[str, str]]:
    """Every (key, text) pair among some settings, at any depth."""
    if isinstance(settings, Mapping):
        for name, value in settings.items():
            yield from texts(value, str(name))
    elif isinstance(settings, list):
        for each in settings:
            yield from texts(each, key)
    elif isinstance(settings, str):
        yield key, settings


def _files_named(settings: object) -> Iterator[str]:
    """Texts that may be paths, with the files of patterns in their place."""
    for key, text in texts(settings):
        if key == "cache" or text in ("", "???"):
            continue
        if "{" in text and not key:
            yield from FilePattern(text).points()[0]
        elif key == "path" and any(sign in text for sign in "*?["):
            yield from files_of(text)
        else:
            yield text


def kept_pieces(keep: str, run: Run, *, aside: Collection[str] = ()) -> Kept:
    """The store of a run's finished pieces, below the folder `keep`; says if it begins anew.

    aside: see `pieces_key`.
    """
    key = pieces_key(run.settings, aside=aside)
    kept = Kept(Path(keep) / key, key)  # runs of other settings may be at work beside it
    if not kept.n_pieces and (others := kept.others()):
        run.say(
            f"this run begins anew: what is kept in {keep} of {len(others)} other "
            f"run{'s' if len(others) > 1 else ''} was made by other settings, data or code"
        )
    return kept


@contextmanager
def told(kept: Kept, run: Run) -> Iterator[None]:
    """Say how to go on, if a run is broken off."""
    try:
        yield
    except KeyboardInterrupt:
        run.say(f"finished pieces are kept in {kept.folder}: the same command goes on with them")
        raise


@contextmanager
def resumed(keep: str, run: Run, workers: Workers = ONE_BY_ONE) -> Iterator[KeptWorkers]:
    """Workers that go on with the pieces that a broken run had finished.

    The pieces are removed once the run has written all that it found.
    """
    kept = kept_pieces(keep, run)
    if kept.n_pieces:
        run.say(f"going on with {kept.n_pieces} pieces that a broken run had done")
    keeping = KeptWorkers(workers, kept)
    with told(kept, run):
        yield keeping
    for reason in keeping.refused:
        run.say(f"some pieces were not kept, and would be computed again: {reason}")
    run.when_written(kept.clear)
