"""Example systems with known equations."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
