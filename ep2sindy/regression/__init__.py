"""Regression: rows of terms and targets in differential or weak form, searches, and fits."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
