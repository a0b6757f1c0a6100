"""What the package warns of: classes to filter by."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
