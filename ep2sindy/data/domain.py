"""Where the functions of a library are defined, along trajectories."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library


def check_domain(runs: Sequence[Trajectory], library: Library) -> None:
    """Raise ValueError naming the first sample at which a function of the library has no value.

    A run must stay in one interval of a function's domain, such as one side of a pole.
    """
    for function in library.functions:
        for k, run in enumerate(runs):
            x = run.columns([function.variable])[:, 0]
            wrong = function.misplaced(x, x[:1] if function.has_poles else x)
            if not wrong.any():
                continue
            first = int(np.argmax(wrong))
            label = f" of {run.label!r}" if run.label else f" of run {k}" if len(runs) > 1 else ""
            others = f" ({wrong.sum()} such samples)" if wrong.sum() > 1 else ""
            raise ValueError(
                f"{function.name} needs {function.need}: {function.variable}[{first}] = "
                f"{x[first]:.6g} at t = {run.t[first]:.6g} s{label}{others}; name functions of the "
                "variables that allow it, as 'log(y)', shift it, as 'log(1+y)', or crop the data"
            )


def kept_inside(
    library: Library,
    moved: Float[np.ndarray, "samples variables"],
    samples: Float[np.ndarray, "samples variables"],
) -> Float[np.ndarray, "samples variables"]:
    """Values moved off samples, by a smoother say, where every function of them is still defined.

    Where one is not, those of `samples` stand. Columns: the library's variables, and more.
    """
    kept = moved
    for function in library.functions:
        v = library.variables.index(function.variable)
        wrong = function.misplaced(moved[:, v], samples[:, v])
        if wrong.any():
            kept = kept.copy() if kept is moved else kept
            kept[wrong, v] = samples[wrong, v]
    return kept
