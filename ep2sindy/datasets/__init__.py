"""Measured records with a free licence, small enough to ship."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
