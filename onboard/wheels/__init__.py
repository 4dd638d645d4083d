"""Wheel encoders and gyro: serial port, line protocol, and readings with stamps on the run's clock.

In: bytes from the wheel controller. Out: wheel readings with sequence number, ticks and time, and yaw rates of its gyro
if it has one. In the paper: the odometry input of the motion model.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
