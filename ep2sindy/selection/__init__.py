"""Selection: rules that choose one candidate of every front."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
