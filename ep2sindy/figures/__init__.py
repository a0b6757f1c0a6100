"""Figures: functions that take values and return a matplotlib Figure."""

from ep2sindy.trust.user_code import away_from

with away_from("matplotlibrc"):  # read first of all settings; an untrusted folder may hold one
    import matplotlib  # noqa: F401
