"""Runs that continue where they were interrupted: what pieces depend on, and what is reported."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from shutil import rmtree
from typing import Any

from ep2sindy.data.run_files import FilePattern
from ep2sindy.data.steps import files_of
from ep2sindy.report.report import Report
from ep2sindy.runtime.files import cache_folder, fingerprint
from ep2sindy.runtime.kept_pieces import CachedWorkers
from ep2sindy.runtime.parallel import ONE_BY_ONE, Workers
from ep2sindy.trust.user_code import PACKAGE, nodes_of, own_source

# Settings of every study that do not change a piece's result; they may differ when a broken run is
# continued.
ALWAYS_ASIDE = {
    "output", "parallel", "keep", "experiment", "study", "verbose", "formats", "figures", "labels",
    "thesis",
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


def texts(settings: object) -> Iterator[tuple[str, str]]:
    """Every (key, text) pair among some settings, at any depth; in a list, its key counts."""
    for place, node in nodes_of(settings):
        if isinstance(node, str):
            yield re.sub(r"\[\d+\]", "", place).rpartition(".")[2], node


def _files_named(settings: object) -> Iterator[str]:
    """Texts that may be paths, with the files of patterns in their place."""
    for key, text in texts(settings):
        if key == "cache" or text in ("", "???"):
            continue
        if "{" in text and not key:
            yield from FilePattern(text).points()[0]
        elif key in ("path", "") and any(sign in text for sign in "*?["):
            yield from files_of(text)
        else:
            yield text


@contextmanager
def resumed(
    keep: bool, report: Report, workers: Workers = ONE_BY_ONE, *, aside: Collection[str] = ()
) -> Iterator[CachedWorkers]:
    """Workers that continue with the pieces that an interrupted run left in the user's cache.

    keep: False begins anew and keeps nothing, so that workers with a part are refused. aside: see
    `pieces_key`.
    The pieces are removed once the run has written all that it found.
    """
    folder = None
    if keep:
        try:
            folder = cache_folder("pieces", pieces_key(report.settings, aside=aside))
        except OSError as error:
            report.say(f"finished pieces are not kept: {error}")
    if folder is not None and folder.exists():
        report.say("going on with the pieces that an earlier run has kept")
    try:
        yield CachedWorkers(workers, folder)
    except KeyboardInterrupt:
        if folder is not None:
            report.say("finished pieces are kept: the same command continues with them")
        raise
    if folder is not None:
        report.when_written(partial(rmtree, folder, ignore_errors=True))
