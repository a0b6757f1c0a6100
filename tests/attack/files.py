"""Mutated files of all kinds: each is read, refused in our words, or it is a fault of ours.

`python -m tests.attack.files` reads the paths that come in, one a line: a process that may die.
"""

from __future__ import annotations

import json
import os
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from tests.attack.results import Outcome

TIMES = 1e-6 * np.arange(40)
VALUES = 1e18 * (2.0 + np.sin(0.3 * np.arange(40)))
ENDINGS = ("nc", "nc3", "nc5", "h5", "mat", "mat73", "npz", "csv", "json", "zarr2", "zarr3")
LIMIT_S, MEMORY = 60.0, 2**31
SAME, OTHER, WRONGLY = "same values", "other values", " without damage to numbers"


Sound = dict[str, bytes]  # the files of a store by their names; of a single file, by "."


def whole(folder: Path) -> dict[str, Sound]:
    """One sound file or store of every kind."""
    import h5py
    import netCDF4
    import xarray as xr
    from scipy.io import savemat

    arrays = {"t": TIMES, "n": VALUES}
    for ending, form in (
        ("nc", "NETCDF4"), ("nc3", "NETCDF3_64BIT"), ("nc5", "NETCDF3_64BIT_DATA"),
    ):  # fmt: skip
        with netCDF4.Dataset(folder / f"a.{ending}", "w", format=form) as file:
            file.createDimension("t", len(TIMES))
            for name, values in arrays.items():
                file.createVariable(name, "f8", ("t",))[:] = values
    for ending, block in (("h5", 0), ("mat73", 512)):
        with h5py.File(folder / f"a.{ending}", "w", userblock_size=block) as file:
            for name, values in arrays.items():
                file.create_dataset(name, data=values, chunks=(10,), compression="gzip")
    content = bytearray((folder / "a.mat73").read_bytes())
    content[:128] = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    (folder / "a.mat73").write_bytes(content)
    with (folder / "a.mat").open("wb") as file:
        savemat(file, {**arrays, "s": {"x": VALUES}}, do_compression=False)
    np.savez_compressed(folder / "a.npz", **arrays)
    rows = "".join(f"{t!r},{n!r}\n" for t, n in zip(TIMES.tolist(), VALUES.tolist(), strict=True))
    (folder / "a.csv").write_text(f"t (s),n (m^-3)\n{rows}")
    (folder / "a.json").write_text(json.dumps({"t": TIMES.tolist(), "n": VALUES.tolist()}))
    data = xr.Dataset({"n": ("t", VALUES)}, {"t": TIMES})
    for version in (2, 3):
        data.to_zarr(folder / f"a.zarr{version}", mode="w", zarr_format=version, consolidated=False)
    return {ending: _files(folder / f"a.{ending}") for ending in ENDINGS}


def _files(place: Path) -> Sound:
    found = [place] if place.is_file() else sorted(p for p in place.rglob("*") if p.is_file())
    return {str(path.relative_to(place)): path.read_bytes() for path in found}


def file_ending(kind: str) -> str:
    """What a file of a kind is called: its version is inside."""
    return kind.rstrip("2357")


def payload(name: str, data: bytes) -> list[range]:
    """Where numbers of the samples stand that nothing in the file checks.

    HDF5 and npz as they are written here check theirs. A chunk of a Zarr store has no checksum.
    """
    if name.rpartition("/")[2] in ("0", "c"):
        return [range(len(data))]
    if data[:1] in b"t{":  # a table, or JSON, as far as its last number
        first = data.index(b"\n" if data[:1] == b"t" else b"[")
        return [range(first, len(data) + 1)]  # a row more at the end, too
    stored = [a.astype(f"{order}f8").tobytes() for a in (TIMES, VALUES) for order in "<>"]
    return [range(data.find(s), data.find(s) + len(s)) for s in stored if s in data]


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """Bytes changed, cut off, doubled, zeroed, or a number made large."""
    changed, n = bytearray(data), len(data)
    at = int(rng.integers(n))
    match rng.integers(6):
        case 0:
            for place in rng.integers(n, size=rng.integers(1, 9)):
                changed[place] = rng.integers(256)
        case 1:
            del changed[at:]
        case 2:
            changed[at:at] = changed[at : at + int(rng.integers(1, 200))]
        case 3:
            end = min(n, at + int(rng.integers(1, 200)))
            changed[at:end] = bytes(end - at)
        case 4:
            changed[at : at + 8] = rng.choice([b"\xff" * 8, b"\x7f" + b"\xff" * 7, b"\0" * 8])
        case _:
            changed[at] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def healed(name: str, before: bytes, after: bytes) -> bytes:
    """A mutated file with sound numbers: what it then tells wrongly was not damage to them."""
    spans = payload(name, before)
    if len(after) != len(before):  # numbers were shifted, or others
        changes = (k for k, (old, new) in enumerate(zip(before, after, strict=False)) if old != new)
        first = next(changes, min(len(before), len(after)))
        return before if any(first in span for span in spans) else after
    content = bytearray(after)
    for span in spans:
        content[span.start : span.stop] = before[span.start : span.stop]
    return bytes(content)


def attack(folder: Path, seed: int) -> Callable[[str], Outcome]:
    """The attack on one case `ENDING-NUMBER`."""
    sound = whole(folder)
    readers: list[subprocess.Popen] = []

    def asked(ending: str, content: Sound) -> Outcome:
        path = folder / f"case.{file_ending(ending)}"
        shutil.rmtree(path, ignore_errors=True)
        for name, data in content.items():
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            (path / name).write_bytes(data)
        if not readers:
            readers.append(_reader())
        kind, words = _asked(readers[0], path)
        if kind in ("crash", "hang"):
            readers.pop().kill()
        return kind, words

    def attacked(case: str) -> Outcome:
        ending, number = case.split("-")
        rng = np.random.default_rng([seed, ENDINGS.index(ending), int(number)])
        name = str(rng.choice(sorted(sound[ending])))
        before = sound[ending][name]
        after = mutated(before, rng)
        kind, words = asked(ending, {**sound[ending], name: after})
        if kind == OTHER:
            again = asked(ending, {**sound[ending], name: healed(name, before, after)})
            kind += WRONGLY if again[0] == OTHER else ""
        return kind, words

    return attacked


def cases(n: int) -> Iterator[str]:
    return (f"{ENDINGS[k % len(ENDINGS)]}-{k // len(ENDINGS)}" for k in range(n))


def _reader() -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-m", "tests.attack.files"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip


def _asked(reader: subprocess.Popen, path: Path) -> Outcome:
    assert reader.stdin is not None
    assert reader.stdout is not None
    begin = time.monotonic()
    reader.stdin.write(f"{path}\n".encode())
    reader.stdin.flush()
    if not select.select([reader.stdout], [], [], LIMIT_S)[0]:
        return "hang", f"over {LIMIT_S:g} s"
    line = reader.stdout.readline()
    if not line:
        return "crash", f"status {reader.wait()} after {time.monotonic() - begin:.1f} s"
    kind, words = json.loads(line)
    return kind, words


def read(path: Path) -> Outcome:
    """The same values, others, a refusal that names the file, or an error that is not ours."""
    from ep2sindy.data.mapping import Variable
    from ep2sindy.data.open import open_field

    try:
        field = open_field(
            path, variables={"n_i": Variable("n", "m^-3")}, time=Variable("t", "s")
        ).load()
    except ValueError as error:
        return ("refused" if path.name in str(error) else "refused, file not named"), str(error)
    except Exception as error:
        return "foreign error", repr(error)
    same = np.array_equal(field["n_i"].values, VALUES) and np.array_equal(field["time"], TIMES)
    return (SAME if same else OTHER), ""


def main() -> None:
    import resource
    import warnings

    warnings.simplefilter("ignore")
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    for line in sys.stdin:
        outcome = read(Path(line.strip()))
        if resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 > MEMORY:
            outcome = ("memory above 2 GiB", outcome[1])
        print(json.dumps(outcome), file=answers, flush=True)


if __name__ == "__main__":
    main()
