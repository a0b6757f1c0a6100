"""Laws of the operating point and what they predict."""
