"""Methods that minimise the distance of integrated windows from the data."""
