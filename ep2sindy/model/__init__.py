"""Sparse models: equations that are evaluated, integrated, scored and stored."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
