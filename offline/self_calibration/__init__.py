"""Which numbers of robot.yaml the drives overrule, and a robot.yaml with what they found.

In: runs and segments. Out: runs with parameters freed, the reasons, and corrected robot files. The paper takes its
robot as calibrated.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
