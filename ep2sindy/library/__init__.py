"""Library of candidate terms: their names, functions and units, and the notation of equations."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
