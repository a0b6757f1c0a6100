"""Names in files: the quantities of a thruster, the axes, counters, and units at a name's end."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from ep2sindy.data.conversion import (
    COORDINATE_UNITS,
    KNOWN_UNITS,
    SUFFIX_UNITS,
    conversion,
    converts,
)
from ep2sindy.data.numbers import without_marks
from ep2sindy.data.readers.table_layout import split_name
from ep2sindy.library.units import is_count, time_unit_in

if TYPE_CHECKING:
    import pandas as pd

STEP_DOUBT = "step_doubt"  # attribute of a field: how dt_s contradicts the file's own times


class DoubtfulUnit(UserWarning):
    """Warns that a step contradicts the file's own times."""


@dataclass(frozen=True)
class KnownQuantity:
    """One quantity of a thruster.

    full: names that say by themselves what they are. short: names that other things bear too, which
    count only beside a unit that fits. Each is a sorted tuple of words as `words_of` returns it.
    """

    unit: str
    full: frozenset[tuple[str, ...]]
    short: frozenset[tuple[str, ...]]


def _names(*texts: str) -> frozenset[tuple[str, ...]]:
    return frozenset(tuple(sorted(text.split())) for text in texts)


QUANTITIES: dict[str, KnownQuantity] = {
    "n_i": KnownQuantity(
        KNOWN_UNITS["n_i"], _names("ion density", "plasma density"),
        _names("n i", "ni", "n ion", "nion", "n plasma", "i density"),
    ),
    "n_n": KnownQuantity(
        KNOWN_UNITS["n_n"], _names("neutral density"),
        _names("n n", "nn", "n neutral", "nneutral", "na", "n a", "ng", "n g"),
    ),
    "u_iz": KnownQuantity(
        KNOWN_UNITS["u_iz"], _names("ion velocity z", "ion axial velocity", "ion velocity"),
        _names("u i z", "uiz", "u i", "ui", "v i z", "viz", "v i", "vi", "u z", "uz", "v z", "vz"),
    ),
    "u_ir": KnownQuantity(
        KNOWN_UNITS["u_ir"], _names("ion velocity r", "ion radial velocity"),
        _names("u i r", "uir", "v i r", "vir", "u r", "ur", "v r", "vr"),
    ),
    "T_e_eV": KnownQuantity(
        "eV", _names("electron temperature"),
        _names("t e", "te", "tev", "t e ev", "t electron", "e temperature"),
    ),
    "R_ion": KnownQuantity(
        KNOWN_UNITS["R_ion"], _names("ionization rate"),
        _names("r i", "r ion", "rion", "k ion", "kion", "k i", "rate", "i rate", "k iz", "kiz",
               "iz rate"),
    ),
    "I_d": KnownQuantity(
        KNOWN_UNITS["I_d"], _names("discharge current"),
        _names("i d", "id", "d current", "current", "idis", "i discharge"),
    ),
    "V_d": KnownQuantity(
        KNOWN_UNITS["V_d"], _names("discharge voltage"),
        _names("v d", "vd", "u d", "ud", "d voltage", "voltage", "vdis", "udis"),
    ),
}  # fmt: skip

ELECTRONS = _names("n e", "ne", "electron density")  # their density is n_i where no charge is left

AXIS_NAMES = {
    "time": _names("t", "time", "times", "timestamp", "tvec", "seconds", "sec"),
    "z": _names("z", "axial", "zz"),
    "r": _names("r", "radial", "rr"),
}

# Names of what numbers or labels samples: no time without a step, and no signal.
COUNTERS = frozenset({
    "cycle", "step", "iteration", "iter", "it", "frame", "index", "idx", "sample", "samples",
    "counter", "count", "sequence", "seq", "row", "record", "id", "ids", "no", "nr",
})  # fmt: skip

# Variables that can be computed if a file lacks them: name -> (source variable, step of `prepare`).
MADE_FROM = {"R_ion": ("T_e_eV", "ep2sindy.thruster.ionization_rate")}

# Words found in names -> their meaning; "" marks a word without meaning.
WORDS = {
    **dict.fromkeys(("densities", "dens", "number"), "density"),
    **dict.fromkeys(("ions",), "ion"),
    **dict.fromkeys(("neutrals", "neut", "atom", "atoms"), "neutral"),
    **dict.fromkeys(("vel", "speed"), "velocity"),
    **dict.fromkeys(("radius", "rad"), "radial"),
    **dict.fromkeys(("temp",), "temperature"),
    **dict.fromkeys(("electrons", "elec"), "electron"),
    **dict.fromkeys(("anode",), "discharge"),
    **dict.fromkeys(("curr",), "current"),
    **dict.fromkeys(("ionisation",), "ionization"),
    **dict.fromkeys(("coefficient", "coeff", "coef"), ""),
    **dict.fromkeys(("grid", "pos", "position", "coord", "coordinate", "coords", "points"), ""),
    **dict.fromkeys(("cells", "centers", "centres", "axis", "vec", "vector", "cell"), ""),
    **dict.fromkeys(("avg", "mean", "average", "averaged", "data", "field", "si"), ""),
}  # fmt: skip

# HallThruster.jl's names, for the lowest charge state.
HALLTHRUSTER = {
    r"ions\.\w+\.0\.n|ni\.0|ni_1": "n_i",
    r"ions\.\w+\.0\.u|ui\.0|ui_1": "u_iz",
    r"neutrals\.\w+\.n": "n_n",
    r"grid|grid\.(z|cell_centers|cellcenters)": "z",
}

# Names of scalars that give the time step in s, or the sampling rate in Hz.
STEPS = frozenset({"dt", "dts", "deltat", "timestep", "sampletime", "samplinginterval"})
RATES = frozenset({"fs", "samplingrate", "samplerate", "samplingfrequency", "fshz"})

# Units written at the end of a name. Their case counts: `mM` is no millimetre.
ENDINGS = {
    "s": "s", "ms": "ms", "us": "us", "ns": "ns", "m": "m", "cm": "cm", "mm": "mm", "eV": "eV",
    "ev": "eV", "K": "K", "A": "A", "mA": "mA", "V": "V", "mV": "mV", "kV": "kV", "m3": "m^-3",
    "cm3": "cm^-3", "m_s": "m/s", "km_s": "km/s", "m3_s": "m^3/s", "cm3_s": "cm^3/s",
}  # fmt: skip


def split_unit(name: str) -> tuple[str, str]:
    """Split a unit off the end of a name: `t_us` gives `t` and `us`; the unit is "" if absent."""
    for ending in sorted(ENDINGS, key=len, reverse=True):
        if name.endswith(f"_{ending}") and len(name) > len(ending) + 1:
            return name[: -len(ending) - 1], ENDINGS[ending]
    return name, ""


def last_of(name: str) -> str:
    """Last part of a path such as `plasma/n_i`; a slash in brackets, as in `x (1/ml)`, is none."""
    return re.split(r"[/.]", re.sub(r"(?<=.)\s*[(\[].*?[)\]]", "", name).rstrip(". "))[-1]


def words_of(name: str) -> tuple[str, ...]:
    """Words of a name, sorted: `ionDensity` and `density_ion` give the same. T alone is no t."""
    if name == "T":
        return ("T",)
    parts = (part.lower() for part in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name))
    return tuple(sorted(word for word in (WORDS.get(part, part) for part in parts) if word))


def step_said(name: str, value: float) -> float | None:
    """Time step in s that a scalar of this name gives, or None if it is no step or rate."""
    last = last_of(name)
    plain = re.sub(r"[^a-z]", "", last.lower())
    if not (np.isfinite(value) and value > 0):
        return None
    return value if plain in STEPS else 1.0 / value if plain in RATES else None


def is_counter_name(name: str) -> bool:
    """True for the name of what numbers samples, or labels them: `frame`, `id`, `Sample_No`."""
    words = words_of(last_of(name))
    return bool(words) and {*words} <= COUNTERS


def axis_of(name: str) -> str | None:
    """The axis that a name in a file says, with or without a unit at its end; None for none."""
    last = last_of(name)
    for pattern, ours in HALLTHRUSTER.items():
        if ours in AXIS_NAMES and re.fullmatch(pattern, name):
            return ours
    for axis, names in AXIS_NAMES.items():
        if {words_of(last), words_of(split_unit(last)[0])} & names:
            return axis
    return "time" if time_unit_in(last) else None


def axis_unit(axis: str, name: str, stated: str) -> str:
    """Unit of an axis: the stated one, or that in its name; "" if neither is given."""
    in_name = (time_unit_in(last_of(name)) or "") if axis == "time" else ""
    options = (stated, in_name, split_unit(last_of(name))[1])
    unit = COORDINATE_UNITS[axis]
    return next((u for u in options if u and (u == unit or converts(axis, u))), "")


def quantity_of(name: str, stated: str, *, plasma: bool = False) -> tuple[str, str] | None:
    """Our name for an array, and the unit it has, "" for none; None if it keeps its own name.

    A short name needs a unit that fits, stated or at its end; a full one stands for itself, unless
    its unit contradicts it. stated: "" for none. plasma: short names stand for themselves too.
    """
    last = last_of(name)
    base, ending = split_unit(last)
    unit = stated or ending
    spelled = {words_of(text) for text in (name, last, base)} if not last.isdigit() else set()
    exact = next((ours for text, ours in HALLTHRUSTER.items() if re.fullmatch(text, name)), None)
    for ours, quantity in QUANTITIES.items():
        is_full = bool(spelled & quantity.full)
        if not (is_full or ours in (exact, last, base) or spelled & quantity.short):
            continue
        fits = converts(ours, unit, is_variable=True) if unit else is_full or plasma
        return (ours, unit) if fits else None
    return None


def own_unit(ours: str, stated: str) -> str:
    """Unit that a file states, or that the suffix of a name promises, if it converts; else "1".

    A count of named things that the file states, such as `animals/ml`, stays as it is.
    """
    if stated and is_count(stated):
        return stated
    suffixes = [unit for suffix, unit in SUFFIX_UNITS.items() if ours.endswith(f"_{suffix}")]
    options = (stated, *suffixes)
    return next((u for u in options if u and converts(ours, u, is_variable=True)), "1")


def columns_in_si(
    table: pd.DataFrame,
) -> tuple[Float[np.ndarray, "rows states"], dict[str, str]]:
    """Samples of a table's columns by the units in their names, and state -> unit."""
    values = np.empty(table.shape)
    units: dict[str, str] = {}
    for k, label in enumerate(table.columns):
        name, stated = (label, "") if label.isidentifier() else split_name(label)
        name, unit = quantity_of(name, stated) or (name, own_unit(name, stated))
        units[name] = unit or "1"
        values[:, k] = without_marks(table[label].to_numpy(dtype=np.float64))
        if units[name] != "1" and not is_count(units[name]):
            factor, zero, units[name] = conversion(name, units[name], is_variable=True)
            values[:, k] = factor * values[:, k] + zero
    return values, units


def time_unit(name: object) -> str | None:
    """Unit of a column of times that is called so, seconds by default; None for another column."""
    if not isinstance(name, str) or axis_of(name) != "time":
        return None
    return axis_unit("time", name, "" if name.isidentifier() else split_name(name)[1]) or "s"
