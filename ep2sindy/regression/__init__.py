"""Regression: rows of terms and targets, in each form that the data can be brought to."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
