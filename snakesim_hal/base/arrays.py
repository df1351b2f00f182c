"""Arrays by what they hold; shape and unit are said where one is used."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
