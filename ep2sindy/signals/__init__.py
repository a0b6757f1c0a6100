"""Signals: smoothing, derivatives, spectra, and the description of oscillations."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
