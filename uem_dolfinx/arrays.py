"""Types of NumPy arrays, for annotations."""

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[np.float64]
Ints: TypeAlias = npt.NDArray[np.int64]
Bools: TypeAlias = npt.NDArray[np.bool_]
AnyArray: TypeAlias = npt.NDArray[Any]
#: Local nodes, facets or cells, as DOLFINx numbers them.
Indices: TypeAlias = npt.NDArray[np.int32]
