"""Arrays in NumPy's format, read on several threads.

NumPy parses the header of an array as Python. Up to Python 3.11.7 two threads that parse at a time disturb one another,
and one of them has a SystemError (python/cpython#106905).
"""

import threading
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

ONE_READER = threading.Lock()
"""To be held while arrays are read in another way than by `read_array`."""


def read_array(file: IO[bytes]) -> NDArray[Any]:
    """Read one array; never a pickle.

    Raises:
        Exception: of nearly any kind, where the file is damaged.
    """
    with ONE_READER:
        return np.asarray(np.lib.format.read_array(file, allow_pickle=False))
