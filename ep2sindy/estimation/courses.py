"""The courses of inputs between their samples, by the likelihood of what they drive."""

from __future__ import annotations

from functools import cache
from math import log

import numpy as np

from ep2sindy.estimation.likelihood import Level
from ep2sindy.estimation.problem import EstimationProblem
from ep2sindy.estimation.solver import at_level, start_from_smooth
from ep2sindy.estimation.working_set import first_set

WARM = 0.1  # rho of the fits that are compared: an input half a step late shows, with all terms
BETTER = 4.0  # least fall of -2 log likelihood for which the most plausible course is left


def on_likeliest_courses(problem: EstimationProblem, *, max_terms: int) -> EstimationProblem:
    """The problem with every input on the likeliest of the courses that its samples allow.

    They are compared before the search, with all terms: a wrong course would ask for wrong ones,
    and pass for a state that comes late. Noise is of unknown size, so that n log(squares) counts.
    """
    if all(len(options) == 1 for options in problem.allowed_courses):
        return problem
    part = problem.restricted(first_set(problem, max_terms))
    start, noise = start_from_smooth(part, None)

    @cache
    def unlikely(courses: tuple[str, ...]) -> float:
        fit, _ = at_level(part.on_courses(courses), start, Level(noise, WARM))
        return part.n_squares * log(max(fit.total, np.finfo(np.float64).tiny))

    best = problem.courses
    for j, options in enumerate(problem.allowed_courses):
        first, *others = [(*best[:j], course, *best[j + 1 :]) for course in options]
        best = min([first, *others], key=lambda c: unlikely(c) - BETTER * (c == first))
    return problem.on_courses(best)
