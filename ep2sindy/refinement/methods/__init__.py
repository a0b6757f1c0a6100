"""Ways to minimise the distance of integrated windows from the data."""
