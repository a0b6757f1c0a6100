"""Headline figures in words: `simple/n_i/r2_test` -> `simple, n_i: R2 on held-out rows`."""

from __future__ import annotations

from ep2sindy.library.units import SECONDS, Clock
from ep2sindy.report.document import cell_text

WORDS = {
    "f_kHz": "frequency",
    "f_error": "error of the frequency (relative)",
    "nrmse": "error of the trajectory (standard deviations)",
    "waveform_error": "error of the waveform (standard deviations)",
    "amplitude_ratio": "amplitude (times the data's)",
    "periods": "periods in phase",
    "r2": "R2",
    "r2_test": "R2 on held-out rows",
    "n_terms": "number of terms",
    "d_pareto": "distance to the corner of the front",
    "deviance": "deviance",
    "identified_percent": "identified (%)",
    "mean_correct_terms": "correct terms (mean)",
    "multiplier": "Floquet multiplier",
    "share_reaching": "share of starts that reach the cycle",
    "cpu_s": "CPU time (s)",
    "cpu_ms": "CPU time (ms)",
    "n_points": "number of points",
    "map_right": "share of the map that is right",
    "living": "the model that lives",
}


def in_words(name: str) -> str:
    """A name made of parts; those without a word stand as they are, blanks for underscores."""
    *where, what = name.split("/")
    text = WORDS.get(what, what.replace("_", " "))
    return f"{', '.join(WORDS.get(part, part) for part in where)}: {text}" if where else text


def value_text(name: str, value: float, clock: Clock = SECONDS) -> str:
    """A headline figure as a cell; a frequency with its unit, in people's time."""
    if name.split("/")[-1] == "f_kHz":
        return clock.frequency_text(1e3 * value)
    return cell_text(value)
