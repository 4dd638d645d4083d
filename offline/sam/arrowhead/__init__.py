"""The normal equations as an arrowhead system: segments are coupled only through tags and calibration.

Order of elimination (`dissection`, `tree`), elimination, substitution, and covariances from the factor (`covariance`,
`marginals`).
"""
