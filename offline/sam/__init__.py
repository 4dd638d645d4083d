"""The back end, square-root smoothing and mapping: factors, graph, solver, covariances.

In: segments of measurements. Out: a `Graph` (variables and factors) and a `Solution` (the maximum a posteriori state,
and covariances from its square-root factor). In the paper this is square-root SAM, with its Jacobians and its QR or
Cholesky solve.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
