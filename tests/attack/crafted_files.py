"""Models, stores and caches that someone has crafted."""

from __future__ import annotations

import json
import os
import pickle
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np

from tests.attack.payloads import BOMB, CANARY, RUNS, Case, Sings

MARKUP = "<img src=x onerror=alert(1)>"


def cases() -> dict[str, Case]:
    return {**_models(), **_runs(), **_stores(), **_archives(), **_texts()}


@cache
def _sound() -> dict[str, Any]:
    import ep2sindy as ep

    return json.loads(ep.lorenz().model.to_json())


def run_folder(**changed: Any) -> dict[str, str]:
    """The files of a run, as `compare` reads them; changed: in place of some."""
    texts = {
        "summary.json": {"experiment": "toy", "seed": 0, "headline": {"r2": 0.5}},
        "provenance.json": {"commit": "c", "versions": {"numpy": "1"}},
        "config.yaml": {"seed": 0},
        "models/m.json": _sound(),
    } | changed
    return {n: v if isinstance(v, str) else json.dumps(v) for n, v in texts.items()}


def compared(names: str, *, may_pass: bool = False, **changed: Any) -> Case:
    """Two runs are compared, the second of which holds what was changed."""
    files = {f"a/{name}": text for name, text in run_folder().items()}
    files |= {f"b/{name}": text for name, text in run_folder(**changed).items()}
    page = ["compare", "a", "b", "--page", "outputs/c.html"]
    return Case(page, files, names, may_pass=may_pass)


def model(change: Mapping[str, Any] | str, **rest: Any) -> Case:
    text = change if isinstance(change, str) else json.dumps(_sound() | change)
    return compared("m.json", **{"models/m.json": text}, **rest)


def _models() -> dict[str, Case]:
    sound = _sound()
    equations, n = sound["equations"], sum(map(len, sound["equations"].values()))
    library = sound["library"]
    many = [f"x^{a}*y^{b}*z^{c}" for a in range(1, 48) for b in range(1, 48) for c in range(1, 48)]
    wide = [f"v{k}" for k in range(8000)]
    twice = json.dumps(sound).replace('"states"', '"states": ["q"], "states"', 1)
    found = {
        "a huge exponent": {"library": [*library, "x^999999999"]},
        "an exponent beyond numbers": {"library": [*library, "x^" + "9" * 5000]},
        "keys that come twice": twice,
        "eight thousand variables": {"variables": [*"xyz", *wide], "library": [*library, *wide]},
        "states that repeat": {"states": ["x", "x", "y", "z"]},
        "NaN": {"equations": {**equations, "x": {"x": float("nan")}}},
        "an integer beyond floats": json.dumps(sound).replace("-10.0", "1" + "0" * 400),
        "an integer beyond Python": json.dumps(sound).replace("-10.0", "1" + "0" * 5000),
        "a number beyond floats": json.dumps(sound).replace("-10.0", "1e999"),
        "deep lists": json.dumps(sound)[:-1] + ', "a": ' + "[" * 100_000 + "]" * 100_000 + "}",
        "a hundred thousand terms": {"library": many},
        "a function that is not there": {"library": [*library, "evil(x)"]},
        "code for a term": {"library": [*library, RUNS]},
        "code for a function": {"library": [*library, "__import__(x)"]},
        "another version": {"format": "ep2sindy.SparseModel/2"},
        "a version that is a list": {"format": []},
        "a covariance that is not symmetric": {"covariance": (np.eye(n) + np.eye(n, k=1)).tolist()},
        "a covariance below zero": {"covariance": (-np.eye(n)).tolist()},
        "a covariance of texts": {"covariance": [["1"] * n] * n},
        "a covariance of truth": {"covariance": [[True] * n] * n},
        "a covariance of depth": {"covariance": [[[[1.0]]]]},
        "a covariance of nothing": {"covariance": [[]] * n},
        "a covariance of null": {"covariance": [[None] * n] * n},
        "variables that are paths": {"variables": ["../../x", "y", "z"]},
        "units that are a list": {"units": ["m"]},
        "no text": "\ud83d".encode("utf-8", "surrogatepass").decode("latin-1"),
        "nothing": "",
        "YAML": "!!python/object/apply:os.abort []",
        "a long term": {"library": [*library, "sin(" + "1" * 40_000 + "!)"]},
        "a long argument": {"library": [*library, "sin(" + "1" * 40_000 + "*x)"]},
        "a state with NUL": _renamed("x", "x\0"),
        "a state that is a path": _renamed("x", "../../x"),
        "a state that is nothing": _renamed("x", ""),
        "a state with a line break": _renamed("x", "x\ny' = 1"),
        "a state that is markup": _renamed("x", "<script>alert(1)</script>"),
    }
    cases = {f"model: {name}": model(change) for name, change in found.items()}
    harmless = {
        "units that are markup": {"units": {"x": MARKUP}},
        "provenance that is markup": {"provenance": {"a": MARKUP}},
        "units that are code": {"units": {"x": RUNS}},
        "units that are a tower": {"units": {"x": "9**9**9**9"}},
        "an average that is markup": _renamed("z", MARKUP, keep_state=True),
        "LaTeX": _renamed("z", r"<\input{/etc/passwd}^{_{$%>", keep_state=True),
        "coefficients at the ends of numbers": {"equations": {**equations, "x": {"x": 5e-324}}},
    }  # fmt: skip
    return cases | {f"model: {n}": model(c, may_pass=True) for n, c in harmless.items()}


def _renamed(old: str, new: str, *, keep_state: bool = False) -> dict[str, Any]:
    """The sound model with one variable called otherwise; as an input, or as the state too."""

    def name(term: str) -> str:
        return "*".join(new if part == old else part for part in term.split("*"))

    def state(text: str) -> str:
        return new if text == old and not keep_state else text

    sound = _sound()
    return {
        "states": [state(each) for each in sound["states"]],
        "variables": [*(new if v == old else v for v in sound["variables"])],
        "library": [name(each) for each in sound["library"] if "^" not in each],
        "equations": {
            state(s): {name(t): v for t, v in terms.items()}
            for s, terms in sound["equations"].items()
        },
        "units": {},
    }


def _runs() -> dict[str, Case]:
    """Folders of runs that are no such."""
    summary = {"experiment": "toy", "seed": 0, "headline": {"r2": 0.5}}
    wrong = {
        "a summary of keys that come twice": {"summary.json": '{"seed": 0, "seed": 1}'},
        "a summary that is a list": {"summary.json": []},
        "a summary without names": {"summary.json": {}},
        "a headline that is text": {"summary.json": summary | {"headline": {"r2": "x"}}},
        "a headline that is a list": {"summary.json": summary | {"headline": [1]}},
        "warnings that are a number": {"summary.json": summary | {"warnings": 5}},
        "data that are a list": {"summary.json": summary | {"data": [1]}},
        "a unit of time that is code": {"summary.json": summary | {"data": {"time_unit": RUNS}}},
        "a deep summary": {"summary.json": "[" * 100_000},
        "a provenance that is a list": {"provenance.json": []},
        "versions that are text": {"provenance.json": {"versions": "x"}},
        "a config that is a list": {"config.yaml": "[1, 2]"},
        "a config of tags": {"config.yaml": "a: !!python/object/apply:os.abort []"},
        "a config that is a bomb": {"config.yaml": BOMB},
        "a deep config": {"config.yaml": "a: " + "[" * 3000 + "]" * 3000},
        "a config that is broken": {"config.yaml": "a: [1"},
    }
    cases = {
        f"run: {name}": compared(next(iter(c)).split("/")[-1], **c) for name, c in wrong.items()
    }
    marked = {"experiment": MARKUP, "seed": 0, "headline": {MARKUP: 1.0}, "warnings": [MARKUP]}
    resolvers = "a: ${oc.env:HOME}\nb: ${hydra:runtime.cwd}\n"
    cases["run: a summary of markup"] = compared("", may_pass=True, **{"summary.json": marked})
    cases["run: resolvers in a config"] = compared("", may_pass=True, **{"config.yaml": resolvers})
    return cases


def _stores() -> dict[str, Case]:
    """Zarr stores."""

    def written(here: Path) -> Path:
        import xarray as xr

        data = {"I_d": ("time", np.arange(5.0), {"units": "A"})}
        field = xr.Dataset(data, coords={"time": ("time", 1e-6 * np.arange(5), {"units": "s"})})
        field.to_zarr(here / "a.zarr", consolidated=False, zarr_format=2)
        return here / "a.zarr"

    def changing(array: str, **changes: Any) -> Callable[[Path], object]:
        def make(here: Path) -> None:
            place = written(here) / array / ".zarray"
            place.write_text(json.dumps(json.loads(place.read_text()) | changes))
            (place.parent / "0").write_bytes(pickle.dumps(Sings()))

        return make

    def replacing(name: str, lay: Callable[[Path], object]) -> Callable[[Path], object]:
        def make(here: Path) -> None:
            place = written(here) / "I_d" / name
            place.unlink()
            lay(place)

        return make

    made: Mapping[str, Callable[[Path], object]] = {
        "a pickle codec": changing("I_d", filters=[{"id": "pickle"}], compressor=None),
        "a pickle codec on a coordinate": changing("time", filters=[{"id": "pickle"}]),
        "objects": changing("I_d", dtype="|O", filters=[{"id": "pickle"}], compressor=None),
        "objects without a codec": changing("I_d", dtype="|O", filters=None, compressor=None),
        "a codec of another name": changing("I_d", compressor={"id": f"{CANARY}.x"}),
        "a shape beyond memory": changing("I_d", shape=[10**12], chunks=[10**12]),
        "a shape beyond numbers": changing("I_d", shape=[10**40], chunks=[10**40]),
        "a shape below zero": changing("I_d", shape=[-5]),
        "chunks without end": changing("I_d", shape=[30_000_000], chunks=[1]),
        "chunks of nothing": changing("I_d", chunks=[0]),
        "a link to a device": replacing("0", lambda place: place.symlink_to("/dev/zero")),
        "a pipe of samples": replacing("0", os.mkfifo),
        "a pipe of metadata": replacing(".zarray", os.mkfifo),
        "a pipe of attributes": replacing(".zattrs", os.mkfifo),
        "deep attributes": replacing(".zattrs", lambda place: place.write_text("[" * 100_000)),
    }
    return {
        f"store: {name}": Case(["inspect", "a.zarr"], {}, "a.zarr", make=make)
        for name, make in made.items()
    }


def _archives() -> dict[str, Case]:
    """Archives and caches that hold pickles."""

    def pickles(here: Path) -> None:
        np.savez(here / "a.npz", t=np.arange(5.0), x=np.array([Sings()] * 5, dtype=object))

    def packed(name: str, content: bytes, n_zeros: int = 0) -> Callable[[Path], object]:
        def make(here: Path) -> None:
            with ZipFile(here / "a.npz", "w", ZIP_DEFLATED) as archive:
                archive.writestr(name, content + bytes(n_zeros))

        return make

    def header(kind: str) -> bytes:
        text = f"{{'descr': {kind}}}".encode().ljust(117) + b"\n"
        return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text

    huge = header("'<f8', 'fortran_order': False, 'shape': (10000000000,)")
    code = header(f"{RUNS}, 'fortran_order': False, 'shape': (1,)")
    made = {
        "pickles": pickles,
        "a name that is a path": packed("../../elsewhere/x.npy", b"\x93NUMPY"),
        "a bomb": packed("x.npy", huge, n_zeros=2**28),
        "code in a header": packed("x.npy", code),
    }
    return {
        f"archive: {name}": Case(
            ["inspect", "a.npz"], {}, "a.npz", may_pass=name != "a bomb", make=make
        )
        for name, make in made.items()
    }


def _texts() -> dict[str, Case]:
    """Tables and JSON."""
    rows = "".join(f"{k},{k}\n" for k in range(1, 9))
    refused = {
        "twice.json": '{"t": [0, 1], "t": [0, 1, 2], "x": [1, 2, 3]}',
        "wider.csv": ",".join(["1"] * 200_000) + "\n",
        "line.csv": "1," * 10_000_000 + "1\n",
        "thousands.csv": "t\tx\n" + "".join(f"{k}\t1,{k:03d}\n" for k in range(9)),
        "word.csv": f"t,x\n0,bad\n{rows}",
        "words.csv": f"t,x\nover,load\n{rows}",
    }
    wide = "t," + ",".join(map(str, range(20_000))) + "\n" + "1," * 20_000 + "1\n"
    files = {
        "deep.json": "[" * 100_000,
        "names.json": json.dumps({MARKUP: [1.0, 2.0], "t": [0.0, 1.0]}),
        "long.json": '{"x": [1' + "0" * 5000 + ", 2]}",
        "wide.csv": wide,
        "repeated.csv": f"t,x,x\n{rows.replace(',', ',1,')}",
        "formula.csv": "t,x\n0,=cmd|' /C calc'!A0\n1,2\n",
        "markup.csv": f"t,[/red]{MARKUP}\n0,1\n1,2\n2,3\n",
        "quoted.csv": 't,x\n0,"1\n' * 50,
        "code.csv": f"t,{RUNS}\n0,1\n1,2\n2,3\n",
        "units.csv": "t (s),x (9**9**9**9)\n0,1\n1,2\n2,3\n",
    }
    return {
        f"text: {name}": Case(["inspect", name], {name: text}, name, may_pass=name in files)
        for name, text in (files | refused).items()
    }
