"""EP2-SINDy: governing equations of plasma-thruster oscillations, found in data."""
