"""What all tests share."""

import gc
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from ep2sindy.app.precompile import precompile
from ep2sindy.report import folder
from ep2sindy.thruster import cache

# Workers share the cores: threads of their own would only get in each other's way.
threadpool_limits(1)
os.environ.setdefault("OMP_NUM_THREADS", "1")  # of PyTorch, which is imported later


def pytest_configure(config: pytest.Config) -> None:
    """Before workers start; a run of one process compiles as it goes."""
    if getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput"):
        precompile()


def pytest_collection_finish() -> None:
    """What is loaded by now stays: garbage is looked for among what tests make."""
    gc.freeze()


def pytest_unconfigure() -> None:
    """At the end nothing is looked for any more."""
    gc.freeze()


@pytest.fixture(autouse=True, scope="session")
def coarse_figures() -> Iterator[None]:
    """Files of figures have few pixels, for nobody looks at them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(folder, "DPI", 40)
        yield


@pytest.fixture(autouse=True, scope="session")
def own_simulations(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Simulations are kept for this session alone, and none of the user's is read."""
    folder = tmp_path_factory.mktemp("simulations")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cache, "cache_folder", lambda kind, key: folder)
        yield


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, in which the test stands."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def predator_prey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A field on (time, z) whose average follows the thesis's Eq. 23, in SI units."""
    from scipy.integrate import solve_ivp  # here, for each process of a run imports this file

    from tests.fields import along_channel

    a, b, c = 1.64e5, 4.66e-14, 4.39e4
    time = 1.5e-6 * np.arange(1200)

    def slope(_: float, x: np.ndarray) -> list[float]:
        burn = b * x[0] * x[1]
        return [burn - a * x[0], c * x[1] - burn]

    found = solve_ivp(slope, time[[0, -1]], [5e17, 4e18], "DOP853", time, rtol=1e-11)
    data = {
        "n_i": (found.y[0], "m^-3"),
        "n_n": (found.y[1], "m^-3"),
        "R_ion": (4e-14 * (1 + 0.3 * np.sin(9e4 * time)), "m^3/s"),
        "u_iz": (5e3 * (1 + 0.2 * np.sin(7e4 * time)), "m/s"),
    }
    field = along_channel(time, np.linspace(0.003, 0.027, 5), data)
    from ep2sindy.data.open import write_field

    path = tmp_path_factory.mktemp("data") / "predator_prey.nc"
    write_field(field, path)
    return path
