"""Records at operating points, and laws of the parameters between them."""
