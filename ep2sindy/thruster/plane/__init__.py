"""The two-dimensional (z, r) fluid model: ions and neutrals in a plane, electrons along z."""
