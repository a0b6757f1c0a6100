"""Forecasts: where a model goes from the end of a record, how certain that is, and how good."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
