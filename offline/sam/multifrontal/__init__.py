"""A multifrontal Cholesky solver on dense blocks, for the corner problem."""
