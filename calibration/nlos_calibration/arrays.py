"""Names of numpy array types."""

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Float16 = NDArray[np.float16]
Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]
Int32 = NDArray[np.int32]
UInt8 = NDArray[np.uint8]
Mask = NDArray[np.bool_]
