"""A multifrontal Cholesky solver on dense blocks, for the joint estimate and the corners."""
