"""Names of array types."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
IndexArray = NDArray[np.int32]  # where there are many, to save memory
BoolArray = NDArray[np.bool_]
