"""Discovery: from data to a model; alone, for several operating points, and on a grid."""
