"""Figures: values in, a matplotlib Figure out."""

from ep2sindy.trust.user_code import away_from

with away_from("matplotlibrc"):  # first of all settings to it, and may be anybody's
    import matplotlib  # noqa: F401
