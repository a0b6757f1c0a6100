"""Configs that someone has crafted: their files, and lines that are typed with them."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from tests.attack.payloads import BOMB, CANARY, RUNS, Case

EVIL = f'{{_target_: sympy.sympify, a: "{RUNS}"}}'
HEAD = "# @package _global_\n"
JUNK = b"\x89HDF\r\n\x1a\n" + bytes(range(256)) * 20
# A run that would take a second, of the table a.csv.
TOY = f"""{HEAD}defaults:
  - override /data: recognised
  - override /formulation: differential
  - override /search: stlsq
  - override /selection: aicc
  - override /bootstraps: none
  - override /parallel: serial
  - _self_
experiment: discover
study: libraries
data: {{path: a.csv}}
trajectory: {{_target_: ep2sindy.data.ZoneAverage, states: [x, y]}}
libraries:
  model: {{variables: [x, y], degree: 1, products: [], functions: [], function_degree: 1}}
rollout_s: null
figures: {{duration_s: null, f_max_Hz: null}}
thesis: {{}}
"""


def config(text: str, names: str, *, base: str = "toy", **rest: Any) -> Case:
    """A file that changes the toy run; a refusal must name what is wrong."""
    theirs = f"{HEAD}defaults: [{base}, _self_]\n{text}"
    files = {"conf/exp/toy.yaml": TOY, "conf/exp/theirs.yaml": theirs}
    return Case(["+exp=theirs"], files, names, **rest)


def cases() -> dict[str, Case]:
    return {**_called(), **_said_to_hydra(), **_written(), **_read(), **_large()}


def _called() -> dict[str, Case]:
    """What would be called or imported."""
    steps = {
        "in a list": f"prepare: [{EVIL}]",
        "below an argument": f"formulation: {{_target_: ep2sindy.Weak, windows: {EVIL}}}",
        "in a list of lists": f"prepare: [[[{EVIL}]]]",
        "by interpolation": "prepare: ['${made}']\nmade: " + EVIL,
        "by oc.create": "prepare: ['${oc.create:\"{_target_: os.system, command: touch x}\"}']",
        "by oc.decode": "prepare: ['${oc.decode:\"{_target_: os.abort}\"}']",
        "of a name put together": "prepare: [{_target_: '${a}.${b}'}]\na: os\nb: abort",
        "in the data": f"data: {EVIL}",
        "in an unused key": f"nobody_reads: {EVIL}",
        "by _args_": f"prepare: [{{_target_: ep2sindy.prepare.crop, _args_: ['{RUNS}']}}]",
        "by _partial_": "prepare: [{_target_: ep2sindy.prepare.crop, _partial_: true}]",
        "by _convert_": "prepare: [{_target_: ep2sindy.prepare.crop, _convert_: all}]",
        "of Hydra": "prepare: [{_target_: hydra.utils.instantiate, a: {_target_: os.abort}}]",
        "of an inner module": "prepare: [{_target_: ep2sindy.runtime.files.write_text}]",
        "of a writer": "prepare: [{_target_: ep2sindy.write_field, path: x.nc}]",
        "of a method": "prepare: [{_target_: ep2sindy.SparseModel.load, path: a.csv}]",
        "of an attribute": "prepare: [{_target_: ep2sindy.prepare.crop.__globals__}]",
        "of a mapping": "prepare: [{_target_: {_target_: os.abort}}]",
        "of NUL": 'prepare: [{_target_: "os\\0.abort"}]',
    }
    found = {f"target {how}": config(text, "") for how, text in steps.items()}
    outside = (
        "this", "idlelib.idle", "os.path", "../x", "a\\0b", "ep2sindy.app.main", "front_view",
    )  # fmt: skip
    found |= {f"study {s}": config(f'study: "{s}"', "study must name") for s in outside}
    for function in ("idlelib.idle.main", "this.s(x)", "os.abort", "__import__('os')", "eval(x)"):
        text = f'libraries: {{model: {{functions: ["{function}"]}}}}'
        found[f"function {function}"] = config(text, function.split(".")[0].split("(")[0])
    expressions = {"a call": RUNS, "an attribute": "x.values", "a lambda": "(lambda: 1)()"}
    for what, text in expressions.items():
        step = f'{{_target_: ep2sindy.prepare.derive, name: n, units: m, expression: "{text}"}}'
        found[f"expression with {what}"] = config(f"prepare: [{step}]", "")
    term = f'libraries: {{model: {{products: ["{RUNS}"]}}}}'
    found["term with a call"] = config(term, "a term is")
    found["unit with a call"] = config(f'data: {{time: {{name: t, unit: "{RUNS}"}}}}', "unit")
    found["relation with a call"] = Case(
        ["+exp=constrained", f'+models.velocity.relations=["{RUNS}"]'], {}, ""
    )
    for tag in ("python/object/apply:os.abort []", "python/name:os.abort", "python/module:this"):
        found[f"YAML tag {tag}"] = config(f"prepare: !!{tag}", "theirs.yaml")
    return found


def _said_to_hydra() -> dict[str, Case]:
    """What is meant for Hydra, wherever it hides."""
    call = f'{{_target_: sympy.sympify, _args_: ["{RUNS}"]}}'
    below = {
        "callbacks": f"callbacks: {{x: {call}}}",
        "job_logging": "job_logging: {version: 1, filters: {f: {'()': os.abort}}}",
        "hydra_logging": f"hydra_logging: {{handlers: {{h: {{filename: {CANARY}}}}}}}",
        "run.dir": "run: {dir: ../elsewhere}",
        "sweep.dir": "sweep: {dir: ../elsewhere}",
        "output_subdir": "output_subdir: elsewhere",
        "job.chdir": "job: {chdir: true}",
        "job.env_set": "job: {env_set: {LD_PRELOAD: ./x.so}}",
        "job.env_copy": "job: {env_copy: [HOME]}",
        "launcher": f"launcher: {{x: {call}}}",
        "sweeper": f"sweeper: {{x: {call}}}",
        "sweeper.params": "sweeper: {params: {seed: '0,1'}}",
        "searchpath": "searchpath: ['pkg://this']",
        "mode": "mode: MULTIRUN",
        "overrides.hydra": "overrides: {hydra: ['output=../elsewhere']}",
        "overrides.task": "overrides: {task: ['output=../elsewhere']}",
        "verbose": "verbose: true",
    }
    found = {}
    for place, text in below.items():
        # Hydra asks for the mode, hears of the refusal, and takes the one that is typed.
        said = config(f"hydra: {{{text}}}", "hydra", may_pass=place == "mode")
        found[f"hydra.{place}"] = said
        found[f"hydra.{place} in a sweep"] = replace(said, arguments=["-m", *said.arguments])
    toy = {"conf/exp/toy.yaml": TOY}
    for group, kind in (("launcher", "BasicLauncher"), ("sweeper", "BasicSweeper")):
        module = f"basic_{group}.{kind}"
        text = f"_target_: hydra._internal.core_plugins.{module}\nx: {call}\n"
        text += "max_batch_size: null\nparams: null\n" if group == "sweeper" else ""
        files = {**toy, f"conf/hydra/{group}/basic.yaml": text}
        found[f"a {group} under the name of Hydra's"] = Case(["-m", "+exp=toy"], files, "hydra")
        chosen = f"{HEAD}defaults: [toy, {{override /hydra/{group}: mine}}, _self_]\n"
        files = {**toy, f"conf/hydra/{group}/mine.yaml": text, "conf/exp/theirs.yaml": chosen}
        found[f"a {group} by a defaults list"] = Case(["-m", "+exp=theirs"], files, "hydra")
    own = {**toy, "conf/config.yaml": f"hydra: {{callbacks: {{x: {call}}}}}\n"}
    found["a config.yaml of theirs"] = Case(["+exp=toy"], own, may_pass=True)
    found["a package override"] = Case(
        ["+exp=theirs"],
        {"conf/exp/theirs.yaml": f"# @package hydra.callbacks\nx: {call}\n"}, "hydra",
    )  # fmt: skip
    return found


def _written() -> dict[str, Case]:
    """Where a run would write."""
    away, data = "../elsewhere", "data: {_target_: ep2sindy.thruster.simulate, cache: ../elsewhere}"
    places = {
        "output": (f"output: {away}", "output"),
        "output by a resolver": ("output: ${oc.env:HOME}", "output"),
        "output put together": ("output: ${a}elsewhere\na: ../", "output"),
        "output as a list": (f"output: [{away}]", "output"),
        "output as a mapping": (f"output: {{a: {away}}}", "output"),
        "output as bytes": ("output: !!binary Li4vZWxzZXdoZXJl", "output"),
        "output as nothing": ("output: null", "output"),
        "output with NUL": ('output: "a\\0b"', "output"),
        "output of a long name": (f"output: {'x' * 5000}", "output"),
        "output on a file": ("output: a.csv", "output"),
        "output by oc.create": ("output: '${oc.create:\"[../elsewhere]\"}'", "output"),
        "cache": (data, "cache"),
        "cache by interpolation": ("data: ${made}\nmade: {cache: ../elsewhere}", "cache"),
        "cache by oc.create": (f"data: '${{oc.create:\"{{{data[7:-1]}}}\"}}'", "cache"),
        "keep": (f"keep: {away}", "keep"),
        "experiment as a path": (f"experiment: {away}", "experiment"),
        "experiment as markup": ("experiment: <b>x</b>", "experiment"),
        "a library as a path": ("libraries: {../../x: {variables: [x], degree: 1}}", "libraries"),
        "a library as markup": ("libraries: {'<b>': {variables: [x], degree: 1}}", "libraries"),
        "a server": (
            "parallel: {_target_: ep2sindy.parallel.Dask, address: 'tcp://h:1'}", "address"
        ),
        "a server by oc.create": (
            "parallel: '${oc.create:\"{_target_: ep2sindy.parallel.Dask, "
            "address: tcp://h.invalid:1}\"}'",
            "address",
        ),
    }  # fmt: skip
    found = {f"writes: {name}": config(*said) for name, said in places.items()}
    scan = f"scan: {{cache: [{away}]}}\ndata: {{duration_s: 1.0e-5, warm_up_s: 0.0}}\n"
    found["writes: a scan over caches"] = config(scan, "cache", base="simulate")
    points = f"points: [{{V_D_V: 300, mdot_mg_s: 5, data: {{cache: {away}}}}}]\n"
    found["writes: a point with a cache"] = config(points, "cache", base="predict")
    sweeper = (
        "_target_: hydra._internal.core_plugins.basic_sweeper.BasicSweeper\nmax_batch_size: null\n"
    )
    git = "{GIT_CONFIG_COUNT: 1, GIT_CONFIG_KEY_0: core.fsmonitor, GIT_CONFIG_VALUE_0: touch c}"
    hydras = {
        "sweeper/basic": f"{sweeper}params: {{output: {away}}}\n",
        "config": "defaults: [output: default, launcher: basic, sweeper: basic, help: default, "
        "hydra_help: default, hydra_logging: default, job_logging: default, callbacks: null, "
        f"env: default]\njob: {{env_set: {git}}}\n",
    }
    for name, text in hydras.items():
        files = {"conf/exp/toy.yaml": TOY, f"conf/hydra/{name}.yaml": text}
        found[f"writes: hydra/{name} of theirs"] = Case(["-m", "+exp=toy"], files, "hydra")
    found["writes: a linked folder"] = config(
        "output: there", "output", make=lambda here: (here / "there").symlink_to("../elsewhere")
    )
    found["writes: a linked folder below"] = config(
        "output: in/there", "output",
        make=lambda here: (here / "in").mkdir() or (here / "in/there").symlink_to(f"../{away}"),
    )  # fmt: skip
    return found


def _read() -> dict[str, Case]:
    """Paths that are no files, or others' files."""
    make: Mapping[str, Callable[[Path], object]] = {
        "pipe.csv": lambda here: os.mkfifo(here / "pipe.csv"),
        "loop.csv": lambda here: (here / "loop.csv").symlink_to("loop.csv"),
        "f.csv": lambda here: (here / "f.csv").mkdir(),
        "junk": lambda here: (here / "junk").write_bytes(JUNK),
    }
    found = {}
    for path in (
        "pipe.csv", "loop.csv", "f.csv", "/dev/zero", "/dev/stdin", "/proc/self/mem",
        "/proc/self/environ", "/", "/dev/tty", "*.nothing", "", "${oc.env:NOT_THERE}",
        "http://h.invalid/a.nc", "file:///etc/passwd", "a.csv::x",
    ):  # fmt: skip
        names = "NOT_THERE" if "$" in path else path.rpartition("//")[2]
        text = f"data: {{path: '{path}'}}"
        found[f"reads: {path or 'nothing'}"] = config(text, names, make=make.get(path))
    found["reads: NUL"] = config('data: {path: "a\\0.csv"}', "csv")
    found["reads: a number"] = config("data: {path: 5}", "path")
    gas = "mass_u: 131, ionization_eV: 12, excitation_eV: 8, double_ionization_eV: 33"
    targets = {
        "a magnetic field": (
            "thruster.magnetic_field",
            "{_target_: ep2sindy.thruster.read_magnetic_field, path: %s, exit_m: 0.025}",
        ),
        "a run to go on from": ("initial", "%s"),
        "a propellant": (
            "thruster.propellant",
            "{_target_: ep2sindy.thruster.read_propellant, path: %s, "
            f"{gas}, second_ionization_eV: 21}}",
        ),
    }
    for path in ("pipe.csv", "/dev/zero", "a.csv", "junk"):
        rest: Any = {"names": path, "make": make.get(path)}
        for what, (key, text) in targets.items():
            typed = ["+exp=simulate", "data.duration_s=3e-5", f"++data.{key}={text % path}"]
            found[f"reads: {path} as {what}"] = Case(typed, **rest)
        typed = ["+exp=simulate", "data=hallthruster_input", f"data.path={path}"]
        found[f"reads: {path} as an input of HallThruster.jl"] = Case(typed, **rest)
    return found


def _large() -> dict[str, Case]:
    """What would take all memory, or for ever."""
    expressions = {
        "deep brackets": "(" * 5000 + "x" + ")" * 5000,
        "many signs": "-" * 3000 + "x",
        "a long sum": "x" + "+x" * 5000,
        "a tower": "x^9^9^9^9^9",
        "a long number": "x*1" + "0" * 400,
        "a longer number": "x*1" + "0" * 50_000,
        "NUL": "x\\0",
        "a power of powers": "9**9**9**9*x",
        "no text": "",
        "surrogates": "x*\\ud800",
    }
    step = '{_target_: ep2sindy.prepare.derive, name: n, units: "1", expression: "%s"}'
    steps = {name: f"prepare: [{step % text}]" for name, text in expressions.items()}
    model = "libraries: {model: {variables: [x, y], %s}}"
    texts = {
        **{name: (text, "expression") for name, text in steps.items()},
        "anchors": (BOMB, "theirs.yaml"),
        "doubling interpolations": (
            "x0: 0123456789\n"
            + "".join(f"x{k}: ${{x{k - 1}}}${{x{k - 1}}}\n" for k in range(1, 40)),
            "may stand for",
        ),
        "an anchor in itself": ("a: &a {b: *a}", "theirs.yaml"),
        "an interpolation of itself": ("data: {path: '${data.path}'}", "data.path"),
        "deep lists": ("a: " + "[" * 3000 + "]" * 3000, "theirs.yaml"),
        "deep mappings": ("a: " + "{b: " * 2000 + "1" + "}" * 2000, "theirs.yaml"),
        "a degree": (model % "degree: 1000000000", "degree"),
        "a degree beyond numbers": (model % f"degree: 1{'0' * 400}", "degree"),
        "a power": (model % "products: ['x^999999999999']", "100 factors"),
        "a power beyond numbers": (model % f"products: ['x^{'9' * 5000}']", "a power must"),
        "a long term": (model % f"products: ['sin({'1' * 40_000}!)']", "a term is"),
        "a long name": (model % f"products: ['{'x' * 100_000}!']", "a term is"),
        "blanks": (model % f"products: ['x{' ' * 100_000}!']", "a term is"),
        "a unit": ("data: {time: {name: t, unit: '9**9**9**9'}}", "unit"),
        "a seed": (f"seed: 1{'0' * 5000}", "theirs.yaml"),
        "a seed that is no number": ("seed: .nan", "seed"),
        "a rollout without end": ("rollout_s: 1.0e+300", "rollout_s"),
        "a depth": ("depth: 1000000000000", "depth"),
        "a depth below zero": ("depth: -1", "depth"),
        "a key of text and NUL": ('"a\\0b": 1', "unknown keys"),
        "a key that is a number": ("1: 2", "unknown keys"),
        "a key that is nothing": ("null: 2", "theirs.yaml"),
    }
    passing = ("a tower", "a long sum", "a power of powers", "a depth", "a rollout without end")
    found = {
        f"large: {name}": config(text, word, may_pass=name in passing)
        for name, (text, word) in texts.items()
    }
    for name, value in {"duration_s": "1e300", "sample_s": "1e-300", "n_cells": "1000000000",
                        "warm_up_s": ".nan", "cfl": ".inf", "stretch": "-1"}.items():  # fmt: skip
        found[f"large: data.{name}={value}"] = Case(
            ["+exp=simulate", f"data.{name}={value}" if name != "cfl" else f"+data.cfl={value}"],
            {}, name,
        )  # fmt: skip
    return found
