"""Shapes and types of the whole package are checked while the tests run."""

import pkgutil
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from jaxtyping import install_import_hook

PACKAGE = Path(__file__).resolve().parents[1] / "ep2sindy"
# Compiled by numba, which cannot look inside a checking wrapper.
COMPILED = ("kernels", "gram_fits")


def checked_modules() -> list[str]:
    """Every module of the package but the compiled ones; hooking a package hooks all below it."""
    names = [m.name for m in pkgutil.walk_packages([str(PACKAGE)], prefix="ep2sindy.")]
    packages = {n for n in names if any(other.startswith(n + ".") for other in names)}
    return [n for n in names if n not in packages and n.rsplit(".", 1)[-1] not in COMPILED]


install_import_hook(checked_modules(), "beartype.beartype")


@pytest.fixture(scope="session")
def predator_prey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A field on (time, z) whose average follows the thesis's Eq. 23, in SI units."""
    a, b, c = 1.64e5, 4.66e-14, 4.39e4
    dt_s, n_samples = 1.5e-6, 1200
    states = np.empty((n_samples, 2))
    states[0] = x = np.array([5e17, 4e18])

    def slope(x: np.ndarray) -> np.ndarray:
        burn = b * x[0] * x[1]
        return np.array([burn - a * x[0], c * x[1] - burn])

    for k in range(1, n_samples):
        for _ in range(4):  # classical Runge-Kutta, a quarter of a sample per step
            h = dt_s / 4
            k1 = slope(x)
            k2 = slope(x + h / 2 * k1)
            k3 = slope(x + h / 2 * k2)
            k4 = slope(x + h * k3)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        states[k] = x
    profile = np.ones((1, 5))
    time = dt_s * np.arange(n_samples)
    data = {
        "n_i": (states[:, :1] * profile, "m^-3"),
        "n_n": (states[:, 1:] * profile, "m^-3"),
        "R_ion": (4e-14 * (1 + 0.3 * np.sin(9e4 * time))[:, None] * profile, "m^3/s"),
        "u_iz": (5e3 * (1 + 0.2 * np.sin(7e4 * time))[:, None] * profile, "m/s"),
    }
    field = xr.Dataset(
        {name: (("time", "z"), v, {"units": unit}) for name, (v, unit) in data.items()},
        coords={"time": time, "z": np.linspace(0.012, 0.028, 5)},
    )
    from ep2sindy.data.open import write_field  # after the hook

    path = tmp_path_factory.mktemp("data") / "predator_prey.nc"
    write_field(field, path)
    return path
