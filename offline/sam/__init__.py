"""The back end: square-root smoothing and mapping. Factors, graph, solver, covariances.

In: segments of measurements. Out: `Graph` (which variables, which factors) and `Solution` (the most likely state, and
exact covariances from its square-root factor). In the paper: square-root SAM, its Jacobians and its QR or Cholesky
solve.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
