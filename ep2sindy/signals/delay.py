"""Terms of a state some time ago, through a chain of stages, so that equations stay ordinary."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.names import check_state
from ep2sindy.runtime.values import check_count, check_positive
from ep2sindy.signals.spectrum import is_uniform

# The chain forgets how it was started: after this many delays, e^-3 of it is left in one stage, and
# less in more.
N_FILLING = 3.0


@dataclass(frozen=True)
class Delay:
    """A delayed state, followed through a chain of equal stages.

    Since the stages are states with known equations, a model with delayed terms is refined,
    integrated and evaluated like any other. Its initial state states what the stages hold.

    Parameters
    ----------
    state : str
        Name of the state.
    delay_s : float
        Delay in s.
    n_stages : int, default 4
        Number of stages. The more stages, the sharper the delay.

    Raises
    ------
    ValueError
        If the delay is not positive, or there is no stage.

    Notes
    -----
    Stage k obeys

        x_k' = (x_(k-1) - x_k) n_stages / delay_s,   x_0 = the state itself

    The last stage is the state of some time ago, averaged over a gamma distribution of mean
    `delay_s` and standard deviation delay_s / sqrt(n_stages).

    Source of the "linear chain trick": MacDonald 1978, Time Lags in Biological Models,
    doi:10.1007/978-3-642-93107-9.

    Examples
    --------
    >>> delay = ep.signals.Delay("x", delay_s=2.0, n_stages=3)
    >>> delay.names
    ('x_lag1', 'x_lag2', 'x_lag3')
    >>> delay.equations["x_lag2"]
    {'x_lag1': 1.5, 'x_lag2': -1.5}
    >>> t = np.linspace(0.0, 60.0, 601)
    >>> long = delay.along(ep.Trajectory(t, 2.0 + np.sin(t)[:, None], ["x"]))
    >>> roles = ep.Roles(equations=delay.equations)  # `library.with_roles(roles)` of the long run
    >>> long.state_names, float(long.t[0])
    (('x', 'x_lag1', 'x_lag2', 'x_lag3'), 6.0)
    """

    state: str
    delay_s: float
    n_stages: int = 4

    def __post_init__(self) -> None:
        check_state(self.state)
        check_count("n_stages", self.n_stages)
        check_positive("delay_s", self.delay_s)

    @property
    def names(self) -> tuple[str, ...]:
        """The states of the stages: `x_lag1` and so on, of a zone `n_n_lag1@exit`."""
        state, at, zone = self.state.partition("@")
        return tuple(f"{state}_lag{k + 1}{at}{zone}" for k in range(self.n_stages))

    @property
    def last(self) -> str:
        """The state `delay_s` ago."""
        return self.names[-1]

    @property
    def equations(self) -> dict[str, dict[str, float]]:
        """The equation of every stage, in SI, for `ep.Roles(equations=...)`."""
        rate = self.n_stages / self.delay_s
        before = (self.state, *self.names)
        return {name: {before[k]: rate, name: -rate} for k, name in enumerate(self.names)}

    def along(self, run: Trajectory) -> Trajectory:
        """The run with the stages as further states.

        They follow the samples, joined by straight lines, and start filled with the first sample.
        Three delays are left out at the beginning, until that is forgotten.
        Raises ValueError for a state that the run lacks, a stage that it has already, unequal time
        steps, or a run that is too short.
        """
        stages = self._stages(run)
        first = int(np.searchsorted(run.t, run.t[0] + N_FILLING * self.delay_s))
        if run.n_samples - first < 2:
            raise ValueError(
                f"a run must last longer than three delays of {self.delay_s:g} s, after which the "
                f"chain is filled, got {run.t[-1] - run.t[0]:g} s; shorten the delay"
            )
        return replace(
            run.window(first, run.n_samples),
            states=np.column_stack([run.states, stages])[first:],
            state_names=(*run.state_names, *self.names),
            units={**run.units, **dict.fromkeys(self.names, run.units[self.state])},
        )

    def _stages(self, run: Trajectory) -> Float[np.ndarray, "samples stages"]:
        from scipy.signal import lsim  # import takes a third of a second

        if self.state not in run.state_names:
            raise ValueError(
                f"a delay is of a state, got {self.state!r}, and the states are "
                f"{list(run.state_names)}"
            )
        if there := sorted(set(self.names) & set(run.names)):
            raise ValueError(f"the run has stages of {self.state!r} already: {there}")
        if not is_uniform(run.t):
            raise ValueError(
                "a delay needs samples at equal time steps: those of this run differ; resample it"
            )
        x = run.columns([self.state])[:, 0]
        rate, n = self.n_stages / self.delay_s, self.n_stages
        into = np.zeros((n, 1))
        into[0] = rate
        flow = rate * (np.eye(n, k=-1) - np.eye(n))
        chain = (flow, into, np.eye(n), np.zeros((n, 1)))
        filled: Float[np.ndarray, "samples stages"] = lsim(
            chain, x, run.t - run.t[0], X0=np.full(n, x[0])
        )[1].reshape(-1, n)
        return filled
