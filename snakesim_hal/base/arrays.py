"""Names of array types. Shape and unit stand where an array is used."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
