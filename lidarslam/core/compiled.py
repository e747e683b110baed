"""Loops over points, compiled to machine code: the only file that knows numba.

They are compiled on their first call and run without the interpreter's lock, so that odometry and mapping run side by
side. Both need this file and share nothing else but the core.
"""

import logging
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

_log = logging.getLogger(__name__)

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """The function, compiled on its first call for the types of its arguments, and kept on disk for the next process.

    It may use NumPy arrays, numbers and tuples of them, constants of its own file, and other compiled functions by
    their own names: what is kept on disk is outdated when a file of these functions changes. Arithmetic is IEEE's, in
    the order that is written; divisions by zero give infinity or NaN, as in NumPy. Indices are not checked.

    Where nothing can be kept (a read-only installation without a home, a full disk, a damaged file), every process
    compiles anew.
    """
    try:
        dispatcher: Any = numba.njit(function, cache=True, nogil=True, error_model="numpy")
    except RuntimeError as reason:  # no folder to keep machine code in
        _log.info("%s", reason)
        dispatcher = numba.njit(function, nogil=True, error_model="numpy")
    else:
        if hasattr(dispatcher, "_cache"):  # not where numba is switched off
            _watch_callees(dispatcher)
            dispatcher._cache = _ForgivingCache(dispatcher._cache)
    return cast(Function, dispatcher)


def _watch_callees(dispatcher: Any) -> None:
    """Numba keeps machine code with the age of the function's file; add those of the functions compiled into it."""
    function = dispatcher.py_func
    named = (function.__globals__.get(name) for name in function.__code__.co_names)
    callees = [other for other in named if hasattr(other, "py_func")]
    files = [other._cache._cache_file for other in (dispatcher, *callees) if hasattr(other._cache, "_cache_file")]
    if files:
        files[0]._source_stamp = tuple(file._source_stamp for file in files)


class _ForgivingCache:
    """Numba's store of one function's machine code, whose files may be damaged and whose folder may be full."""

    def __init__(self, cache: Any) -> None:
        self._cache = cache

    def __getattr__(self, name: str) -> Any:
        return getattr(self._cache, name)

    def load_overload(self, *arguments: Any) -> Any:
        """What is kept for these types; None when there is nothing, or nothing that can be read."""
        try:
            return self._cache.load_overload(*arguments)
        except Exception as reason:  # a damaged pickle may raise anything
            _log.info("compiled code cannot be read, and is made anew: %s", reason)
            self._begin_anew()
            return None

    def save_overload(self, *arguments: Any) -> None:
        """Keep what was compiled, if that is possible."""
        try:
            self._cache.save_overload(*arguments)
        except Exception as reason:
            _log.info("compiled code cannot be kept: %s", reason)

    def _begin_anew(self) -> None:
        try:
            self._cache.flush()
        except OSError as reason:
            _log.info("compiled code cannot be kept: %s", reason)
