"""Known quantities of a thruster: units, typical sizes and aliases of our usual names."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import xarray as xr

from ep2sindy.data.conversion import KNOWN_UNITS, conversion
from ep2sindy.data.fields import COORDINATE_UNITS

STEP_DOUBT = "step_doubt"  # attribute of a field: how dt_s contradicts the file's own times


class DoubtfulUnit(UserWarning):
    """Warns that numbers look like another unit than the stated one, or contradict a step."""


@dataclass(frozen=True)
class KnownQuantity:
    """One quantity of a thruster.

    low, high: range of the median magnitude, in `unit`. others: further units that files often
    use. words: aliases, each a sorted tuple of words as `words_of` returns it.
    """

    unit: str
    low: float
    high: float
    others: tuple[str, ...]
    words: frozenset[tuple[str, ...]]

    def fits(self, size: float, factor: float = 1.0) -> bool:
        """True if a median magnitude is plausible for this quantity; 0 (all zeros) always is."""
        return size == 0.0 or self.low <= factor * size <= self.high


def _names(*texts: str) -> frozenset[tuple[str, ...]]:
    return frozenset(tuple(sorted(text.split())) for text in texts)


_SI = COORDINATE_UNITS | KNOWN_UNITS
QUANTITIES: dict[str, KnownQuantity] = {
    "n_i": KnownQuantity(
        _SI["n_i"], 1e14, 1e21, ("cm^-3",),
        _names("n i", "ni", "i n0 n", "i dens", "n_i", "nion", "n plasma", "dens plasma"),
    ),
    "n_n": KnownQuantity(
        _SI["n_n"], 1e15, 1e24, ("cm^-3",),
        _names("n n", "nn", "n neutral", "nneutral", "neutral dens", "na", "n a", "ng", "n g"),
    ),
    "u_iz": KnownQuantity(
        _SI["u_iz"], 50.0, 2e5, ("km/s",),
        _names("u i z", "uiz", "u i", "ui", "viz", "vi", "u z", "uz", "vz", "i z u", "i vel z"),
    ),
    "u_ir": KnownQuantity(
        _SI["u_ir"], 1.0, 2e5, ("km/s",),
        _names("u i r", "uir", "vir", "u r", "ur", "vr"),
    ),
    "T_e_eV": KnownQuantity(
        "eV", 0.1, 300.0, ("K",),
        _names("t e", "te", "tev", "t electron", "e temp", "electron temp", "temp e"),
    ),
    "R_ion": KnownQuantity(
        _SI["R_ion"], 0.0, 1e-11, ("cm^3/s",),
        _names("r i", "rion", "kion", "k i", "rate", "i rate", "kiz", "k iz", "iz rate"),
    ),
    "I_d": KnownQuantity(
        _SI["I_d"], 1e-3, 300.0, ("mA",),
        _names("i d", "id", "d current", "current", "d i", "idis", "i discharge"),
    ),
    "V_d": KnownQuantity(
        _SI["V_d"], 1.0, 2e4, ("kV", "mV"),
        _names("u d", "vd", "ud", "d voltage", "voltage", "vdis", "udis"),
    ),
}  # fmt: skip

AXES: dict[str, KnownQuantity] = {
    "time": KnownQuantity(
        "s", 0.0, np.inf, ("us", "ms", "ns"),
        _names("t", "time", "times", "timestamp", "tvec", "seconds", "sec"),
    ),
    "z": KnownQuantity("m", 1e-4, 1.0, ("mm", "cm"), _names("z", "axial", "zz")),
    "r": KnownQuantity("m", 1e-4, 1.0, ("mm", "cm"), _names("r", "radial", "rr")),
}  # fmt: skip

# Variables that can be computed if a file lacks them: name -> (source variable, step of `prepare`).
MADE_FROM = {"R_ion": ("T_e_eV", "ep2sindy.thruster.ionization_rate")}

PLASMA = frozenset({"n_i", "n_n", "u_iz", "u_ir", "T_e_eV", "R_ion"})
LONGEST_STEP_S = 1e-3  # longest plausible time step of plasma records: ten breathing periods

# Words found in names -> their meaning; "" marks a word without meaning.
WORDS = {
    **dict.fromkeys(("density", "densities", "number"), "dens"),
    **dict.fromkeys(("ion", "ions", "plus"), "i"),
    **dict.fromkeys(("neutrals", "neut", "atom", "atoms", "gas"), "neutral"),
    **dict.fromkeys(("v", "velocity", "vel", "speed"), "u"),
    **dict.fromkeys(("radius", "rad"), "radial"),
    **dict.fromkeys(("temperature",), "temp"),
    **dict.fromkeys(("electrons", "el", "elec"), "electron"),
    **dict.fromkeys(("discharge", "dis", "anode"), "d"),
    **dict.fromkeys(("curr",), "current"),
    **dict.fromkeys(("volt", "volts", "potential"), "voltage"),
    **dict.fromkeys(("ionization", "ionisation", "iz", "ioniz"), "iz"),
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

# Units written at the end of a name.
ENDINGS = {
    "s": "s", "ms": "ms", "us": "us", "ns": "ns", "m": "m", "cm": "cm", "mm": "mm", "ev": "eV",
    "k": "K", "a": "A", "ma": "mA", "v": "V", "mv": "mV", "kv": "kV", "m3": "m^-3", "cm3": "cm^-3",
    "m_s": "m/s", "km_s": "km/s", "m3_s": "m^3/s", "cm3_s": "cm^3/s",
}  # fmt: skip


def split_unit(name: str) -> tuple[str, str | None]:
    """Split a unit off the end of a name: `t_us` gives `t` and `us`; the unit is None if absent."""
    for ending in sorted(ENDINGS, key=len, reverse=True):
        if name.lower().endswith(f"_{ending}") and len(name) > len(ending) + 1:
            return name[: -len(ending) - 1], ENDINGS[ending]
    return name, None


def last_of(name: str) -> str:
    """Last part of a path such as `plasma/n_i`; a slash in brackets, as in `x (1/ml)`, is none."""
    return re.split(r"[/.]", re.sub(r"(?<=.)\s*[(\[].*?[)\]]", "", name))[-1]


def words_of(name: str) -> tuple[str, ...]:
    """Meanings of the words in a name, sorted: `ionDensity` and `density_ion` give the same."""
    parts = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name)
    said = [WORDS.get(part.lower(), part.lower()) for part in parts]
    return tuple(sorted(word for word in said if word))


def step_said(name: str, value: float) -> float | None:
    """Time step in s that a scalar of this name gives, or None if it is no step or rate."""
    last = last_of(name)
    plain = re.sub(r"[^a-z]", "", last.lower())
    if not (np.isfinite(value) and value > 0):
        return None
    return value if plain in STEPS else 1.0 / value if plain in RATES else None


def meant_by(name: str) -> set[str]:
    """Our names that a name in a file may stand for, judged by its last part or its whole path."""
    known = QUANTITIES | AXES
    if name in known:
        return {name}
    exact = {ours for pattern, ours in HALLTHRUSTER.items() if re.fullmatch(pattern, name)}
    if exact:
        return exact
    last = last_of(name)
    for text in (last, split_unit(last)[0], name, split_unit(name)[0]):
        if last.isdigit():
            break
        if said := words_of(text):
            found = {ours for ours, quantity in known.items() if said in quantity.words}
            if found:
                return found
    return set()


def typical(values: np.ndarray) -> float:
    """Median magnitude of the values that are neither zero nor missing; 0 if there are none."""
    sizes = np.abs(values[np.isfinite(values) & (values != 0)])
    return float(np.median(sizes)) if sizes.size else 0.0


def likely_time_unit(step: float, names: Iterable[str]) -> str | None:
    """Unit of time in which a plasma's record has steps near 1 us; None if seconds are plausible.

    step: time step in the file's numbers. names: variables of the record. Without a plasma
    variable the result is None, since a current alone may be logged once a second.
    """
    if step <= LONGEST_STEP_S or not PLASMA & {*names}:
        return None
    factors = {unit: conversion("time", unit)[0] for unit in AXES["time"].others}
    return min(factors, key=lambda unit: abs(np.log10(step * factors[unit] / 1e-6)))


def unit_doubts(field: xr.Dataset) -> list[str]:
    """Messages about quantities whose numbers look like another unit.

    Densities of 1e12 m^-3, for example, suggest that the file uses cm^-3. On a grid only the
    middle sample in time is examined. A step that contradicts the file's times comes first.
    """
    found = [str(field.attrs[STEP_DOUBT])] if STEP_DOUBT in field.attrs else []
    step = float(np.diff(field["time"].values[:2])[0])
    if (unit := likely_time_unit(step, map(str, field.data_vars))) is not None:
        found.append(
            f"time goes in steps of {step:.2g} s, as if the file counted in {unit}: give its unit, "
            f"data.time.unit={unit}, or leave this aside if it is right"
        )
    for name, quantity in (QUANTITIES | AXES).items():
        # A variable z without that axis is a state of another system.
        if name not in (field.dims if name in AXES else field.data_vars):
            continue
        array = field[name]
        if "time" in array.dims and array.ndim > 1:
            array = array.isel(time=array.sizes["time"] // 2)
        size = typical(np.asarray(array.values, dtype=np.float64))
        if quantity.fits(size):
            continue
        looks = [unit for unit in quantity.others if quantity.fits(size, conversion(name, unit)[0])]
        if looks:
            found.append(
                f"{name} is about {size:.2g} {quantity.unit}, as if the file counted in "
                f"{' or '.join(looks)}: give its unit, data{_place(name)}.unit={looks[0]}, or "
                "leave this aside if it is right"
            )
    return found


def _place(name: str) -> str:
    return f".{name}" if name in AXES else f".variables.{name}"
