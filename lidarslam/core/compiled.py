"""Loops over points, compiled to machine code: the only file that knows numba.

They are compiled on their first call and run without the interpreter's lock, so that odometry and mapping run side by
side. Both need this file and share nothing else but the core.
"""

import contextlib
import hashlib
import logging
import os
import tempfile
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar, cast

import numba
import numba.extending
from numba.core import cgutils, types
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile, InTreeCacheLocator
from numpy.typing import NDArray

_log = logging.getLogger(__name__)

Function = TypeVar("Function", bound=Callable[..., Any])

_njit: Any = numba.njit
_config: Any = numba.config
_intrinsic: Any = numba.extending.intrinsic
_tools: Any = cgutils
# Nothing calls these loops by their addresses: an entry less to compile.
_OPTIONS = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}


def compiled(function: Function) -> Function:
    """The function, compiled on its first call for the types of its arguments, and kept on disk for the next process.

    It may use NumPy arrays, numbers and tuples of them, constants of its own file, and other compiled functions by
    their own names: the code on disk is outdated when a file of these functions changes. Arithmetic is IEEE's, in
    the order that is written; divisions by zero give infinity or NaN, as in NumPy. Indices are not checked.

    Kept next to the source, else in the user's cache folder, else in a temporary folder of the user. Code that was kept
    next to the source when the program was installed is used wherever the rest is kept. Where nothing can be kept (a
    full disk, a damaged file), every process compiles the rest again.
    """
    dispatcher = _part(function, no_cpython_wrapper=False)
    if hasattr(dispatcher, "source_stamps"):
        with contextlib.suppress(RuntimeError):  # a function without a file
            dispatcher._cache = cast(Any, _KeptCode)(function, dispatcher.source_stamps)
    return cast(Function, dispatcher)


def compiled_part(function: Function) -> Function:
    """A part of compiled functions: compiled and kept along with them, and never called from the interpreter."""
    return cast(Function, _part(function))


def compiled_sums(function: Function) -> Function:
    """As `compiled_part`, with sums in any order, which a processor takes several numbers at once of."""
    return cast(Function, _part(function, fastmath={"reassoc", "contract", "nsz"}))


def _prefetch(_context: Any, array: Any, _row: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        first = context.make_array(signature.args[0])(context, builder, values[0])
        (width, *_) = _tools.unpack_tuple(builder, first.strides, signature.args[0].ndim)
        address = builder.add(builder.ptrtoint(first.data, width.type), builder.mul(width, values[1]))
        pointer, flag = _tools.voidptr_t, _tools.ir.IntType(32)
        kind = _tools.ir.FunctionType(_tools.ir.VoidType(), [pointer, flag, flag, flag])
        fetch = builder.module.declare_intrinsic("llvm.prefetch", (pointer,), kind)
        # For reading, into the caches of all levels, data.
        builder.call(fetch, [builder.inttoptr(address, pointer), *(flag(value) for value in (0, 3, 1))])
        return context.get_dummy_value()

    return types.void(array, types.intp), generate


prefetch: Callable[[NDArray[Any], int], None] = (
    (lambda _array, _row: None) if _config.DISABLE_JIT else _intrinsic(_prefetch)
)
"""Prefetch a row of an array into the processor's cache: a hint, for compiled functions alone.

Any row number will do, also of no row. Of random accesses that depend on what is read, the processor overlaps few.
"""


def is_compiled(module: ModuleType) -> bool:
    """Whether machine code of all compiled functions of a module is on disk; also where none can be kept there."""
    own = [value for value in vars(module).values() if getattr(value, "__module__", None) == module.__name__]
    caches = [value._cache for value in own if hasattr(value, "_cache")]
    return all(cache.has_overloads() for cache in caches if isinstance(cache, _KeptCode))


def _part(function: Callable[..., Any], no_cpython_wrapper: bool = True, **options: Any) -> Any:
    dispatcher = _njit(function, no_cpython_wrapper=no_cpython_wrapper, **_OPTIONS, **options)
    if hasattr(dispatcher, "_cache"):  # not where numba is switched off
        # Numba keeps machine code with the state of the function's file; these are of the functions in it as well.
        code, names = dispatcher.py_func.__code__, dispatcher.py_func.__globals__
        callees = [names[name] for name in code.co_names if hasattr(names.get(name), "source_stamps")]
        stamps = {stamp for callee in callees for stamp in callee.source_stamps}
        dispatcher.source_stamps = (*sorted({_stamp(code.co_filename), *stamps}),)
    return dispatcher


def _stamp(file: str) -> str:
    try:
        return hashlib.sha256(Path(file).read_bytes()).hexdigest()
    except OSError:  # made up by the program
        return ""


@lru_cache(maxsize=1)
def _temporary_folder() -> str:
    """A folder for compiled code that no other user can write; empty where there is none."""
    folder = Path(tempfile.gettempdir()) / f"lidarslam-{os.getuid() if hasattr(os, 'getuid') else 0}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError:
        return ""
    is_own = not hasattr(os, "getuid") or (status.st_uid == os.getuid() and not status.st_mode & 0o022)
    return str(folder) if is_own and not folder.is_symlink() else ""


class _Temporary(InTreeCacheLocator):
    """The temporary folder of the user."""

    def __init__(self, function: Any, file: str) -> None:
        super().__init__(function, file)  # type: ignore[no-untyped-call]
        self._cache_path = str(Path(_temporary_folder()) / self.get_suitable_cache_subpath(file))  # type: ignore[no-untyped-call]

    def ensure_cache_path(self) -> None:
        """OSError where there is none."""
        if not _temporary_folder():
            raise FileNotFoundError("no temporary folder")
        super().ensure_cache_path()  # type: ignore[no-untyped-call]


class _Installed(InTreeCacheLocator):
    """The folder next to a function's source, where it cannot be written."""

    def ensure_cache_path(self) -> None:
        """Nothing is made."""


class _Places(CompileResultCacheImpl):
    _locator_classes: Any = (*CompileResultCacheImpl._locator_classes, _Temporary, _Installed)


@lru_cache(maxsize=1)
def _warn_of_compiling_anew() -> None:
    _log.warning(
        "compiled loops find no folder to be kept in, so that every start compiles them, for up to a minute;"
        " set NUMBA_CACHE_DIR to a folder that can be written"
    )


class _KeptCode(FunctionCache):
    """Numba's store of one function's machine code, whose files may be damaged and whose folder may be full."""

    _impl_class = _Places

    def __init__(self, function: Any, source_stamps: tuple[str, ...]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        own: Any = self._cache_file
        own._source_stamp = source_stamps
        self._is_kept = not isinstance(self._impl.locator, _Installed)
        beside = str(Path(function.__code__.co_filename).parent / "__pycache__")
        # Made when the program was installed; only read.
        self._installed: Any = None
        if self.cache_path != beside:
            self._installed = IndexDataCacheFile(beside, self._impl.filename_base, source_stamps)  # type: ignore[no-untyped-call]

    def has_overloads(self) -> bool:
        """Whether anything is kept; True where nothing can be."""
        try:
            files = (self._cache_file, self._installed)
            return not self._is_kept or any(file._load_index() for file in files if file is not None)
        except Exception as reason:  # a damaged pickle may raise anything
            _log.info("compiled code cannot be read: %s", reason)
            return False

    def load_overload(self, *arguments: Any) -> Any:
        """The machine code kept for these types; None when there is none that can be read."""
        own = self._cache_file
        for file in (own, self._installed):
            self._cache_file = file
            try:
                if file is not None and (loaded := super().load_overload(*arguments)) is not None:  # type: ignore[no-untyped-call]
                    return loaded
            except Exception as reason:  # a damaged pickle may raise anything
                _log.info("compiled code cannot be read, and is made again: %s", reason)
                with contextlib.suppress(OSError):
                    if file is own and self._is_kept:
                        self.flush()  # type: ignore[no-untyped-call]
            finally:
                self._cache_file = own
        return None

    def save_overload(self, *arguments: Any) -> None:
        """Keep the compiled code, if that is possible."""
        if not self._is_kept:
            _warn_of_compiling_anew()
            return
        try:
            super().save_overload(*arguments)  # type: ignore[no-untyped-call]
        except Exception as reason:
            _log.info("compiled code cannot be kept: %s", reason)
