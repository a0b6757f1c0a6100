"""The search for equations as a scikit-learn estimator."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
