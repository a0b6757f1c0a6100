"""Signals: smoothed samples and derivatives, spectra, and what describes an oscillation."""
