"""Steps that prepare a field before trajectories are taken from it."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
