"""Synthetic systems with known coefficients, against which searches are tested."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import polynomial
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.model.solve import solve_stages


@dataclass(frozen=True, eq=False)
class System:
    """A known model, with the sampling that the thesis uses (appendix, II-E).

    Parameters
    ----------
    name : str
        Name of the system.
    model : SparseModel
        Its equations.
    initial : (n_states,) array
        State at t = 0.
    duration_s : float
        Length of a trajectory in s.
    rate_Hz : float
        Sampling rate in Hz.
    """

    name: str
    model: SparseModel
    initial: Float[np.ndarray, " n_states"]
    duration_s: float
    rate_Hz: float

    def trajectory(
        self,
        *,
        initial: Float[np.ndarray, " n_states"] | None = None,
        noise: float = 0.0,
        rng: np.random.Generator | int | None = None,
    ) -> Trajectory:
        """Integrate with tolerance 1e-10, and add white noise.

        Parameters
        ----------
        initial : (n_states,) array, optional
            State at t = 0. None takes that of the system.
        noise : float, default 0.0
            Standard deviation of the noise, as a fraction of each state's RMS.
        rng : Generator or int, optional
            Generator of the noise, or its seed.

        Returns
        -------
        Trajectory
            The samples.

        Raises
        ------
        ValueError
            If the noise is negative, or not zero without an rng, or if fewer than two samples fit
            into the duration.
        """
        if noise < 0.0 or (noise > 0.0 and rng is None):
            raise ValueError(
                f"noise must be zero, or positive together with an rng: noise={noise}, rng={rng}"
            )
        start = np.asarray(self.initial if initial is None else initial, dtype=np.float64)
        t, states = _integrated(
            self.name, self.model.to_json(), tuple(start.tolist()), self.duration_s, self.rate_Hz
        )
        if rng is not None:
            generator = np.random.default_rng(rng)
            rms = np.sqrt(np.square(states).mean(axis=0))
            states = states + noise * rms * generator.standard_normal(states.shape)
        return Trajectory(t=t, states=states, state_names=self.model.states, label=self.name)


@lru_cache(maxsize=64)  # realizations often differ only in the noise added to one trajectory
def _integrated(
    name: str, model: str, initial: tuple[float, ...], duration_s: float, rate_Hz: float
) -> tuple[Float[np.ndarray, " samples"], Float[np.ndarray, "samples n_states"]]:
    """Times and states of a model that is given as JSON, so that it can be a key of the cache."""
    equations = SparseModel.from_json(model)
    t = np.arange(round(duration_s * rate_Hz)) / rate_Hz
    if len(t) < 2:
        raise ValueError(f"a trajectory needs two samples: {len(t)} fit in")
    found = solve_stages(
        lambda _, x: equations.derivative(x, np.empty(0)),
        t,
        np.array(initial),
        rtol=1e-10,
        limit_s=60.0,
    )
    if found.ended_early:
        raise ValueError(
            f"{name} must run for duration_s={duration_s:g}: {found.message}; "
            "choose milder parameters or a shorter duration"
        )
    states = found.y
    states.flags.writeable = False
    return t, states


def damped_oscillator(*, zeta: float = 0.1, omega: float = 3.0) -> System:
    """A linear oscillator with damping.

    Parameters
    ----------
    zeta : float, default 0.1
        Damping ratio.
    omega : float, default 3.0
        Angular frequency in rad/s.

    Returns
    -------
    System
        The model, with an initial state and a sampling.

    Notes
    -----
    The equations are

        x' = v
        v' = -2 zeta omega v - omega^2 x
    """
    equations = {"x": {"v": 1.0}, "v": {"x": -(omega**2), "v": -2.0 * zeta * omega}}
    return _system("damped oscillator", equations, 2, [1.0, 0.0], 30.0, 100.0)


def lotka_volterra(*, a: float = 2 / 3, b: float = 1.0, c: float = 1.0, d: float = 1 / 3) -> System:
    """The Lotka-Volterra system of prey x and predator y, a family of neutral cycles.

    Parameters
    ----------
    a : float, default 2 / 3
        Growth rate of the prey, in 1/s.
    b : float, default 1.0
        Rate at which predators reduce the prey.
    c : float, default 1.0
        Rate at which predators grow with the prey.
    d : float, default 1 / 3
        Death rate of the predators, in 1/s.

    Returns
    -------
    System
        The model, with an initial state and a sampling of 100 s at 10 Hz.

    Notes
    -----
    The equations are

        x' = a x - b x y
        y' = c x y - d y

    Source: Volterra 1926, doi:10.1038/118558a0.

    Examples
    --------
    >>> print(ep.lotka_volterra(a=0.5).model.text())
    x' = 0.5 x - x y
    y' = -0.333 y + x y
    """
    equations = {"x": {"x": a, "x*y": -b}, "y": {"y": -d, "x*y": c}}
    return _system("Lotka-Volterra", equations, 2, [1.0, 0.5], 100.0, 10.0)


def van_der_pol(*, mu: float = 2.0) -> System:
    """The Van der Pol oscillator in the form of Lienard, a relaxation oscillation.

    Parameters
    ----------
    mu : float, default 2.0
        Strength of the nonlinear damping.

    Returns
    -------
    System
        The model, with an initial state and a sampling.

    Notes
    -----
    The equations are

        x' = mu (x - x^3/3 - y)
        y' = x / mu
    """
    equations = {"x": {"x": mu, "y": -mu, "x^3": -mu / 3.0}, "y": {"x": 1.0 / mu}}
    return _system("Van der Pol", equations, 3, [1.0, 1.0], 20.0, 50.0)


def lorenz(*, sigma: float = 10.0, rho: float = 28.0, beta: float = 8 / 3) -> System:
    """The Lorenz system, the standard example of a chaotic attractor.

    Parameters
    ----------
    sigma : float, default 10.0
        Prandtl number.
    rho : float, default 28.0
        Relative Rayleigh number. At 28 the system is chaotic.
    beta : float, default 8 / 3
        Aspect ratio of the convection roll.

    Returns
    -------
    System
        The model, with an initial state and a sampling of 10 s at 300 Hz.

    Notes
    -----
    The equations are

        x' = sigma (y - x)
        y' = x (rho - z) - y
        z' = x y - beta z

    Source: Lorenz 1963, `doi:10.1175/1520-0469(1963)020<0130:DNF>2.0.CO;2`.

    Examples
    --------
    >>> ep.lorenz().trajectory(noise=0.05, rng=0).states.shape
    (3000, 3)
    """
    equations = {
        "x": {"x": -sigma, "y": sigma},
        "y": {"x": rho, "x*z": -1.0, "y": -1.0},
        "z": {"x*y": 1.0, "z": -beta},
    }
    return _system("Lorenz", equations, 2, [-8.0, 8.0, 27.0], 10.0, 300.0)


def pendulum(*, length: float = 1.0, gravity: float = 9.81) -> System:
    """A pendulum without friction, released at 2 rad and followed for 20 s.

    Parameters
    ----------
    length : float, default 1.0
        Length in m.
    gravity : float, default 9.81
        Gravity in m/s^2.

    Returns
    -------
    System
        The model of the angle theta in rad and the angular velocity w in rad/s.

    Notes
    -----
    The equations are

        theta' = w
        w' = -(gravity / length) sin(theta)

    Examples
    --------
    >>> print(ep.pendulum().model.text())
    theta' = w
    w' = -9.81 sin(theta)
    """
    equations = {"theta": {"w": 1.0}, "w": {"sin(theta)": -gravity / length}}
    return _system("pendulum", equations, 1, [2.0, 0.0], 20.0, 100.0, ["sin"])


def _system(
    name: str,
    equations: Mapping[str, Mapping[str, float]],
    degree: int,
    initial: Sequence[float],
    duration_s: float,
    rate_Hz: float,
    functions: Sequence[str] = (),
) -> System:
    library = polynomial(list(equations), degree=degree, functions=functions)
    coef = coef_matrix(library, list(equations.values()))
    model = SparseModel(library, list(equations), coef, provenance={"truth": name})
    return System(name, model, np.array(initial), duration_s, rate_Hz)
