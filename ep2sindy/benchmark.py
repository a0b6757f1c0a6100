"""PySINDy beside this package: its variants, as a benchmark fits them."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
