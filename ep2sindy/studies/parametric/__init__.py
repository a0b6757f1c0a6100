"""The parametric study: one model at several operating points, its trends and laws."""
