"""The embedded data source: a 1-D axial Hall-thruster fluid model."""
