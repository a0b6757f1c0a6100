"""The records: what they are, where they come from, and their licences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.units import Clock

FOLDER = Path(__file__).parent


def pendulum_swing() -> Trajectory:
    """Angle theta, in rad, of one free, damped swing of a single pendulum, 5.5 s at 1 kHz.

    Returns
    -------
    Trajectory
        The record.

    Notes
    -----
    The bearing has dry friction. The encoder has steps of about 5e-4 rad.

    Source: Kaheman, Fasel, Bramburger, Strom, Kutz & Brunton 2022, arXiv:2205.06231,
    github.com/dynamicslab/MultiArm-Pendulum, MIT licence, (c) 2022 dynamicslab.

    Examples
    --------
    >>> ep.data.pendulum_swing().n_samples
    5500
    """
    return _read("pendulum", ["theta"], {"theta": "rad"})


def hare_lynx() -> Trajectory:
    """Pelts of hare and lynx, in thousands, that the Hudson's Bay Company traded, 1900 to 1920.

    Returns
    -------
    Trajectory
        The record. Times are in s, and displayed in years since 1900.

    Notes
    -----
    Source: Odum 1953, Fundamentals of Ecology; public figures.

    Examples
    --------
    >>> ep.data.hare_lynx().states[0].tolist()
    [30.0, 4.0]
    """
    return _read("hare_lynx", ["hare", "lynx"], {}, unit="year", begins=1900.0)


def gause() -> Trajectory:
    """Counts of Paramecium aurelia and of its prey, a yeast, per 0.5 ml, on 18 days.

    Returns
    -------
    Trajectory
        The record. Times are in s, and displayed in days.

    Notes
    -----
    Source: Gause, Smaragdova & Witt 1935; digitised in github.com/gugushvili/predator_prey, CC0.

    Examples
    --------
    >>> ep.data.gause().state_names
    ('paramecium', 'yeast')
    """
    return _read("gause", ["paramecium", "yeast"], {}, unit="day")


def _read(
    name: str,
    states: Sequence[str],
    units: Mapping[str, str],
    *,
    unit: str = "s",
    begins: float = 0.0,
) -> Trajectory:
    table = np.loadtxt(FOLDER / f"{name}.csv", delimiter=",", skiprows=1)
    clock = Clock.of(unit)
    return Trajectory(
        t=(table[:, 0] - begins) * clock.seconds,
        states=table[:, 1:],
        state_names=tuple(states),
        units=units,
        label=name,
        clock=clock,
    )
