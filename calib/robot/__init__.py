"""robot.yaml and the names of the calibration parameters.

In: robot.yaml, or a noise file. Out: `Robot` (wheels, mount, tags, devices, each calibrated value with its sigma),
`NoiseParameters`, and the names of the calibration parameters that an estimate may free. In the paper: the constants of
its motion and sensor models.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
