"""Figures: values in, a matplotlib Figure out."""

from ep2sindy.machine.own import away_from

with away_from("matplotlibrc"):  # first of all settings to it, and may be anybody's
    import matplotlib  # noqa: F401
