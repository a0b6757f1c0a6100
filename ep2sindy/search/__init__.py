"""The search: supports proposed from Gram matrices, and the front of error against size."""
