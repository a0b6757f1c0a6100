"""Models, rows and pointwise studies of a few numbers, for any test."""

from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library, named_terms
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.regression.rows import RegressionRows


def model_of(
    equations: Mapping[str, Mapping[str, float]], inputs: Sequence[str] = ()
) -> SparseModel:
    """A model with a library of its own terms alone."""
    names = list(dict.fromkeys(name for terms in equations.values() for name in terms))
    library = named_terms([*equations, *inputs], names)
    return SparseModel(library, list(equations), coef_matrix(library, [*equations.values()]))


def slopes_of(library: Library, values: np.ndarray) -> np.ndarray:
    """Derivative of every term by every variable, (variables, samples, terms)."""
    products, weights = library.with_derivatives(len(library.variables))
    return np.einsum("sp,tvp->vst", products.evaluate(values), weights[:, 1:])


def plain_rows(
    theta: np.ndarray,
    target: np.ndarray,
    terms: Library | Sequence[str],
    equations: Sequence[str] = ("y",),
) -> RegressionRows:
    """Rows that share no samples, none held out; terms that are names are variables."""
    library = terms if isinstance(terms, Library) else named_terms(terms, terms)
    n = len(theta)
    return RegressionRows(theta, target, library, equations, np.arange(n), np.zeros(n, dtype=bool))


def point_study(
    coef: np.ndarray,
    weight: np.ndarray,
    lost: np.ndarray,
    *,
    terms: Mapping[str, str],
    equations: Sequence[str] = ("n_i", "n_n"),
    fraction: np.ndarray | None = None,
    draws: np.ndarray | None = None,
) -> xr.Dataset:
    """What a pointwise study finds.

    coef, weight, fraction: (equation, term, z, r); fraction: of the bootstraps that have a term.
    lost: (z, r), points without plasma. terms: with the units of their coefficients.
    draws: (draw, equation, term, z, r), weights of bootstraps; without them two agree with all.
    """
    dims = ("draw", "equation", "term", "z", "r")
    found = {
        "coef": coef,
        "weight": weight,
        "inclusion": np.ones_like(weight) if fraction is None else fraction,
        "weight_draws": np.stack([weight] * 2) if draws is None else draws,
    }
    held = xr.DataArray(~lost, dims=dims[3:])
    flags = {"flag_values": [0, 1], "flag_meanings": "fitted no_plasma"}
    arrays = {name: xr.DataArray(v, dims=dims[-v.ndim :]).where(held) for name, v in found.items()}
    arrays["n_terms"] = (arrays["coef"] != 0.0).sum("term").where(held)
    arrays["status"] = xr.where(held, 0, 1).astype(np.int8).assign_attrs(flags)
    coords = {
        "equation": list(equations),
        "term": list(terms),
        "coef_units": (dims[1:3], [list(terms.values())] * len(equations)),
        "z": ("z", np.linspace(0.002, 0.022, lost.shape[0]), {"units": "m"}),
        "r": ("r", np.linspace(0.036, 0.049, lost.shape[1]), {"units": "m"}),
    }
    return xr.Dataset(arrays, coords=coords, attrs={"no_fit": ""})


def lienard(a: float) -> Trajectory:
    """van der Pol's states after Lienard, on their cycle; a period takes seven seconds."""
    model = model_of({"p": {"p": a, "q": -1.0, "p^3": -0.3}, "q": {"p": 1.0}})
    t = 0.1 * np.arange(1000)
    return Trajectory(t[:700], model.simulate(t, [1.0, 0.0]).states[300:], ["p", "q"])
