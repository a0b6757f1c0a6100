"""Operating points: records, laws of the operating point, and maps of what they predict."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
