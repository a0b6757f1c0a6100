"""Distances between parts of one record; no model run can be expected to lie closer to it."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from jaxtyping import Float

from ep2sindy.signals.attractor import distribution_distances, spectrum_distance
from ep2sindy.signals.spectrum import dominant_frequency

# Number of parts of a record, and periods that each part must hold; otherwise there are two parts.
N_PARTS, TURNS = 4, 2.0


def quarter_distances(
    t: Float[np.ndarray, " samples"], states: Float[np.ndarray, "samples n_states"]
) -> tuple[Float[np.ndarray, " n_states"], float]:
    """Mean distances between quarters of a record: of distributions, by state, and of spectra.

    If the quarters are independent, the distance is twice that between two whole records of the
    same motion. Halves are compared if a quarter holds less than two periods of the fastest state.
    """
    fastest_Hz = max(dominant_frequency(t, column) for column in states.T)
    n_parts = N_PARTS if fastest_Hz * (t[-1] - t[0]) >= N_PARTS * TURNS else 2
    n = len(t) // n_parts
    pairs = list(combinations([states[k * n : (k + 1) * n] for k in range(n_parts)], 2))
    distributions = [distribution_distances(*pair) for pair in pairs]
    spectra = [spectrum_distance(t[:n], *pair) for pair in pairs]
    return np.mean(distributions, axis=0), float(np.mean(spectra))
