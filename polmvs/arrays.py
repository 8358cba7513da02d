"""Array types used in annotations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Image = NDArray[np.float32]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]
