"""How far parts of one record are apart: no run of a model can be asked to lie closer to it."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from jaxtyping import Float

from ep2sindy.signals.attractor import distribution_distances, spectrum_distance
from ep2sindy.signals.spectrum import dominant_frequency

N_PARTS, TURNS = 4, 2.0  # parts of a record, and turns that each must hold; else there are two


def quarter_distances(
    t: Float[np.ndarray, " samples"], states: Float[np.ndarray, "samples n_states"]
) -> tuple[Float[np.ndarray, " n_states"], float]:
    """Mean distance of distributions, by state, and of spectra, between quarters of a record.

    Twice what two whole records of the same motion are apart, if their parts are independent.
    Between halves where quarters hold less than two turns of the fastest state.
    """
    fastest_Hz = max(dominant_frequency(t, column) for column in states.T)
    n_parts = N_PARTS if fastest_Hz * (t[-1] - t[0]) >= N_PARTS * TURNS else 2
    n = len(t) // n_parts
    pairs = list(combinations([states[k * n : (k + 1) * n] for k in range(n_parts)], 2))
    distributions = [distribution_distances(*pair) for pair in pairs]
    spectra = [spectrum_distance(t[:n], *pair) for pair in pairs]
    return np.mean(distributions, axis=0), float(np.mean(spectra))
