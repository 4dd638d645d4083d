"""The normal equations as an arrowhead: segments eliminated one by one, met in tags and calibration.

Ordering (`dissection`, `tree`), elimination, substitution, and exact covariances from the factor (`covariance`,
`marginals`).
"""
