"""Signals: smoothed samples and derivatives, spectra, and what describes an oscillation."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
