"""Reaction networks and an epidemic by the default search under roles of mass action.

    python -m benchmarks.networks [--n 2]

Five networks of three to five species, one record each of 800 samples at 1 and 5 % noise (of each
state's RMS), and an epidemic with births and deaths at 20 %. Right means that exactly the true
terms were found. Next to it the same search without roles. Then 64 random starts of every model
that was found under roles are followed: how many turn negative.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

import ep2sindy as ep
from ep2sindy.data.trajectory import Trajectory
from tests.models import model_of

N_STARTS = 64


@dataclass(frozen=True)
class Network:
    """Equations, a start, the length of the record, and what is known of the roles."""

    equations: Mapping[str, Mapping[str, float]]
    start: tuple[float, ...]
    duration_s: float
    roles: ep.Roles
    n_samples: int = 800


def exchanging(*pairs: tuple[str, str], out: str = "", feed: str = "") -> ep.Roles:
    """Roles of mass action: pairs that exchange, species that leave, and that are fed."""
    return ep.Roles(
        exchange=pairs, outflow=out.split(), inflow=dict.fromkeys(feed.split(), "free"),
        nonnegative=True,
    )  # fmt: skip


NETWORKS = {
    # A <-> B <-> C, reversible
    "reversible chain": Network(
        {
            "A": {"A": -1.0, "B": 0.4},
            "B": {"A": 1.0, "B": -1.1, "C": 0.2},
            "C": {"B": 0.7, "C": -0.2},
        },
        (1.0, 0.1, 0.0), 12.0, exchanging(("A", "B"), ("B", "C")),
    ),
    # A + X -> 2 X, X + Y -> 2 Y, feed of A, decay of Y: autocatalysis in two steps
    "autocatalysis": Network(
        {
            "A": {"1": 0.5, "A": -0.1, "A*X": -1.0},
            "X": {"A*X": 1.0, "X*Y": -1.2},
            "Y": {"X*Y": 1.2, "Y": -0.5},
        },
        (1.0, 0.5, 0.3), 40.0,
        exchanging(("A", "X"), ("X", "Y"), out="A Y", feed="A"),
    ),
    # X -> Y by Z, Y -> Z alone, Z -> X by X: a catalytic loop, closed
    "catalytic loop": Network(
        {
            "X": {"X*Z": -0.9, "X*Y": 0.6, "Z": 0.3},
            "Y": {"X*Z": 0.9, "X*Y": -0.6, "Y": -0.5},
            "Z": {"Y": 0.5, "Z": -0.3},
        },
        (1.0, 0.3, 0.2), 25.0, exchanging(("X", "Y"), ("Y", "X"), ("Y", "Z"), ("Z", "X")),
    ),
    # Two prey on one feed, in a flow reactor
    "chemostat": Network(
        {
            "S": {"1": 1.0, "S": -0.5, "S*P": -1.0, "S*Q": -0.8},
            "P": {"S*P": 1.0, "P": -0.5, "P*Q": -0.3},
            "Q": {"S*Q": 0.8, "P*Q": 0.3, "Q": -0.5},
        },
        (1.5, 0.2, 0.1), 40.0,
        exchanging(("S", "P"), ("S", "Q"), ("P", "Q"), out="S P Q", feed="S"),
    ),
    # A -> B -> C -> D -> E, where C drives A -> B
    "cascade of five": Network(
        {
            "A": {"A": -0.2, "A*C": -1.5},
            "B": {"A": 0.2, "A*C": 1.5, "B": -0.8},
            "C": {"B": 0.8, "C": -0.6},
            "D": {"C": 0.6, "D": -0.4},
            "E": {"D": 0.4, "E": -0.15},
        },
        (2.0, 0.1, 0.0, 0.0, 0.0), 25.0,
        exchanging(("A", "B"), ("B", "C"), ("C", "D"), ("D", "E"), out="E"),
    ),
}  # fmt: skip
EPIDEMIC = Network(
    {
        "S": {"1": 0.05, "S": -0.05, "S*I": -2.0},
        "I": {"S*I": 2.0, "I": -0.55},
        "R": {"I": 0.5, "R": -0.05},
    },
    (0.9, 0.05, 0.05), 60.0,
    exchanging(("S", "I"), ("I", "R"), out="S I R", feed="S"), 601,
)  # fmt: skip


def record(network: Network, noise: float, seed: int) -> Trajectory:
    """One run with white noise, a fraction of each state's RMS."""
    states = list(network.equations)
    t = np.linspace(0.0, network.duration_s, network.n_samples)
    path = model_of(network.equations).simulate(t, np.array(network.start)).states
    rms = np.sqrt(np.square(path).mean(axis=0))
    noisy = path + noise * rms * np.random.default_rng(seed).normal(size=path.shape)
    return Trajectory(t, noisy, states)


def is_right(found: ep.Discovery, network: Network) -> bool:
    return all(
        set(found.model.terms(state)) == set(terms) for state, terms in network.equations.items()
    )


def n_negative(model: ep.SparseModel, network: Network) -> int:
    """Of random starts between nothing and twice the largest value, how many turn negative."""
    rng, t = np.random.default_rng(0), np.linspace(0.0, network.duration_s, 400)
    largest = record(network, 0.0, 0).states.max(axis=0)
    paths = [
        model.simulate(t, 2.0 * largest * rng.uniform(size=len(largest))) for _ in range(N_STARTS)
    ]
    return sum(bool((path.states < -1e-6 * largest).any()) for path in paths)


def counts(name: str, network: Network, noise: float, n: int) -> None:
    """Print how many of n records give the true terms, with roles and without."""
    library, right, negative = ep.polynomial(list(network.equations), degree=2), [0, 0], 0
    for seed in range(n):
        run = record(network, noise, seed)
        found = ep.discover(run, library.with_roles(network.roles))
        right[0] += is_right(found, network)
        negative += n_negative(found.model, network)
        right[1] += is_right(ep.discover(run, library), network)
    print(
        f"{name:18s} {100 * noise:3.0f} %: right with roles {right[0]}, without {right[1]} of {n}; "
        f"{negative} of {N_STARTS * n} runs turn negative",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--n", type=int, default=2, help="records of each network and noise")
    n = parser.parse_args().n
    for noise in (0.01, 0.05):
        for name, network in NETWORKS.items():
            counts(name, network, noise, n)
    counts("epidemic", EPIDEMIC, 0.2, 10 * n)


if __name__ == "__main__":
    main()
