"""Work shared by cores or machines, and how it tells how far it is."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
