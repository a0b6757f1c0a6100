"""Discovery: methods that find models from data, pointwise searches of a grid, and regimes."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
