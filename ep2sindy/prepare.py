"""Steps that prepare trajectories, fields and what is read from them."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
