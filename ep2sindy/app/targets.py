"""What a config may call: nothing but what is written here, and what users mark as theirs.

A config can come from anybody. Values, readers and simulators are offered; what writes where it
is told, or runs what it is given, is not.
"""

from __future__ import annotations

from collections.abc import Callable
from difflib import get_close_matches
from typing import Any

from omegaconf import DictConfig, OmegaConf

import ep2sindy
from ep2sindy.machine.own import is_for_configs, own_module

# Names of the package's face.
_NAMES = """
Variable open_field read_field simulate simulate_cached simulate_2d simulate_2d_cached
simulate_hallthruster_input three_regions
crop decimate low_pass derive radial_from_middle keep_where ionization_rate
Zone ZoneAverage GridPoint LogRate Rate Delays
Regression TrajectorySearch Recipe Differential Weak WeightedWeak Bumps Boxes RandomSplit BlockSplit
KalmanSmoother LogSmoother SavitzkyGolay NoSmoothing
AdaptiveLasso STLSQ BestSubset Bootstraps
AICc EBIC Evidence FreeRunScore Bounds Knee RefinedScore
Serial Loky Dask
GradientDescent MultipleShooting NelderMead SingleShooting RungeKutta HermiteSimpson
Refining Quantity TimeBootstrap Windows
PySINDyVariant PySINDyStlsq PySINDySsr PySINDyEnsemble PySINDyWeakForm PySINDySmoothing
damped_oscillator lotka_volterra van_der_pol lorenz pendulum
Thruster OperatingPoint landmark_thruster MagneticField MagneticFieldTable
read_magnetic_field propellant read_propellant PropellantTable TabulatedRates XenonFits
AnomalousTransport GaussianTransport MultiLogTransport ExponentialWall SheathWall
wall_material AnodeSheath FixedAnode ColdStart GuessedStart Restart SoftStart
"""
FOR_CONFIGS = frozenset(_NAMES.split())


def target_of(node: DictConfig, place: str) -> Callable[..., Any]:
    """What the `_target_` of a node names.

    Raises ValueError for all that configs may not name, before anything of it is imported.
    """
    name = str(node["_target_"])
    module, _, last = name.rpartition(".")
    room = module.partition(".")[0]
    if module == "ep2sindy" and last in FOR_CONFIGS:
        return getattr(ep2sindy, last)
    if room and room != "ep2sindy":
        return _own(name, place)
    near = get_close_matches(last, FOR_CONFIGS)
    there = [f"ep2sindy.{each}" for each in near or sorted(FOR_CONFIGS)]
    raise ValueError(
        f"{place} must name a _target_ that there is, such as ep2sindy.EBIC, and that is for "
        f"configs: {name!r} came; {'near it are' if near else 'there are'} {', '.join(there)}"
    )


def _own(name: str, place: str) -> Callable[..., Any]:
    """What a user has marked; only a file below the current folder is imported."""
    module, _, last = name.rpartition(".")
    try:
        target = getattr(own_module(module), last)
    except (ModuleNotFoundError, AttributeError) as error:
        raise ValueError(
            f"{place} must name a _target_ of ep2sindy that is for configs, such as "
            f"ep2sindy.EBIC, or one of yours below the folder that you start in: {name!r} came, "
            f"and {error}"
        ) from error
    if not is_for_configs(target):
        raise ValueError(
            f"{place} must name a _target_ that is for configs: {name!r} came; if it is yours, "
            f"mark it with @ep.for_configs where it is defined"
        )
    return target


def check_targets(node: Any, place: str = "") -> None:
    """Raise ValueError for a `_target_`, at any depth, that configs may not name.

    What is interpolated is looked at where it stands, and once more when it is built.
    """
    if isinstance(node, DictConfig) and "_target_" in node and _is_there(node, "_target_"):
        target_of(node, place or "the config")
    keys: Any = node if isinstance(node, DictConfig) else range(len(node))
    for key in keys:
        if _is_there(node, key) and OmegaConf.is_config(node[key]):
            dotted = f"{place}.{key}" if place else str(key)
            check_targets(node[key], dotted if isinstance(node, DictConfig) else f"{place}[{key}]")


def _is_there(node: Any, key: Any) -> bool:
    return not (OmegaConf.is_missing(node, key) or OmegaConf.is_interpolation(node, key))
