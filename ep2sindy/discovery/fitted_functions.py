"""Numbers inside functions that are to be fitted, such as the width in `sign(?*v)`."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library
from ep2sindy.library.names import number_text

FITTED = "?"  # stands for a number to be fitted

# Numbers tried, in standard deviations of the variable that they are added to, or in their inverse
# if they multiply it; then the best is refined.
SIZES = 10.0 ** np.arange(-3.0, 1.6, 0.25)
TOLERANCE = 0.01  # of the logarithm of a number
DIGITS = 4  # that are kept of it

LibraryOf = Callable[[Sequence[str]], Library]
Misfit = Callable[[Library], float]


def fit_functions(
    functions: Sequence[str], run: Trajectory, library_of: LibraryOf, misfit: Misfit
) -> list[str]:
    """The functions with every `?` replaced by the number whose library fits a run best.

    One after the other: earlier numbers are kept while later ones are fitted, and functions whose
    number is still unknown are left out meanwhile. library_of: library with some functions. misfit:
    how badly the best equations of a library fit; infinite if they cannot be used.
    Raises ValueError for a function with more than one `?`, of no variable of the run, or none of
    whose numbers can be used.
    """
    from scipy.optimize import minimize_scalar  # imported only to fit a number

    known = [text for text in functions if FITTED not in text]
    for text in functions:
        if FITTED not in text:
            continue
        unit = _unit(text, run)

        def off(log_size: float, text: str = text, unit: float = unit) -> float:
            return misfit(library_of([*known, _filled(text, np.exp(log_size), unit)]))

        tried = np.array([off(log_size) for log_size in np.log(SIZES)])
        if not np.isfinite(tried).any():
            raise ValueError(
                f"no number in the place of {FITTED} lets {text!r} be used on these data: its "
                "argument leaves the domain; write the number yourself, or another function"
            )
        best = int(np.argmin(tried))
        around = (max(best - 1, 0), min(best + 1, len(SIZES) - 1))
        bounds = tuple(np.log(SIZES[k]) for k in around)
        found = minimize_scalar(off, bounds=bounds, method="bounded", options={"xatol": TOLERANCE})
        log_size = found.x if found.fun < tried[best] else np.log(SIZES[best])
        known.append(_filled(text, np.exp(log_size), unit))
    return known


def _unit(text: str, run: Trajectory) -> float:
    """Standard deviation of the variable that a function with one unknown number is of."""
    named = [name for name in run.names if name in _words(text)]
    if text.count(FITTED) != 1 or len(named) != 1:
        raise ValueError(
            f"a function with a number to be fitted must have one {FITTED} and one variable of "
            f"{list(run.names)}, such as 'sign({FITTED}*{run.names[-1]})' or "
            f"'1/({FITTED}+{run.names[0]})': {text!r} came"
        )
    return float(run.columns(named).std())


def _words(text: str) -> list[str]:
    kept = "".join(c if c.isalnum() or c in "_@" else " " for c in text)
    return kept.split()


def _filled(text: str, size: float, unit: float) -> str:
    """The function with a number: a factor in 1/unit, or a summand in unit."""
    is_factor = f"{FITTED}*" in text.replace(" ", "")
    number = 1.0 / (size * unit) if is_factor else size * unit
    return text.replace(FITTED, number_text(float(f"{number:.{DIGITS}g}")))
