"""Selection: rules that choose one candidate from every Pareto front."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
