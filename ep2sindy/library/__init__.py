"""The library: candidate terms, their names and units, and how equations are written."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
