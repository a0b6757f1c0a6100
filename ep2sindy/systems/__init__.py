"""Example systems, whose equations are known."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
