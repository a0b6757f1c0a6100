"""Discovery: from data to a model; alone, for several operating points, and on a grid."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
