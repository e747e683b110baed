"""Return of free memory to the system.

The C library keeps what was freed between blocks in use, for each thread by itself. Maps that are given up, searches,
and tables that are merged leave ever more of it.
"""

import ctypes

# Scans between two returns, which take some milliseconds.
EVERY_SCANS = 100


def return_free_memory() -> None:
    """Return all pages without a block in use; does nothing where the C library cannot."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc's alone
    if trim is not None:
        trim(0)
