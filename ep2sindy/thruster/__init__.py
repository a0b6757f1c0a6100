"""The embedded data source: a 1-D axial Hall-thruster fluid model."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
