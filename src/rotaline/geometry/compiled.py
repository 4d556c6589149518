"""Compiled kernels: functions on arrays that numba turns into machine code when they are first called.

The machine code is kept on disk, so that a second run does not compile. numba notices by itself when the module of a kernel has changed,
but not when a kernel that it calls has; so the folder is named after all modules with kernels: those whose names end in ``kernels``.

A kernel is written as::

    @compiled
    @no_type_check
    def kernel(image: np.ndarray, out: np.ndarray) -> int: ...

``no_type_check`` keeps run-time checks of annotations out of what is compiled. Kernels release the interpreter's lock, so that threads run side
by side; they raise nothing and check nothing: the functions that call them do.
"""

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

F = TypeVar("F", bound=Callable[..., Any])


def _cache_folder() -> Path:
    """Beside the package, where that can be written; else in the user's folder for such things."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256(numba.__version__.encode())
    for path in (Path(__file__), *sorted(package.rglob("*kernels.py"))):
        digest.update(path.read_bytes())
    name = f"kernels-{digest.hexdigest()[:16]}"
    for base in (
        package / "__pycache__",
        Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rotaline",
    ):
        try:
            (base / name).mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=base / name):
                return base / name
        except OSError:
            continue
    return Path(tempfile.gettempdir()) / f"rotaline-{name}"


if not os.environ.get("NUMBA_CACHE_DIR"):
    numba.config.CACHE_DIR = str(_cache_folder())  # type: ignore[attr-defined]


def machine_code_stored(module: str) -> bool:
    """Whether kernels of a module (``find_kernels``) were compiled before; if not, the first call takes a while."""
    return any(Path(numba.config.CACHE_DIR).rglob(f"{module}.*.nbc"))  # type: ignore[attr-defined]


def compiled(function: F) -> F:
    """Compile a kernel for the types of its arguments when it is called with them.

    Divisions by zero give infinities as in NumPy. Sums may be reordered (for vector instructions), but NaN and infinities keep their meaning.
    Kernels that are called become part of the one that calls, or else the order would depend on whether their machine code was stored.
    """
    fastmath = {"reassoc", "contract", "arcp", "nsz"}
    return cast(
        F, numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=fastmath, forceinline=True)(function)
    )


@intrinsic
def prefetch(_: Any, image: Any, row: Any, column: Any) -> Any:
    """Have the memory around a pixel brought near, without waiting for it; a pixel beyond the image does no harm. For kernels only."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        at = cgutils.get_item_pointer(context, builder, signature.args[0], array, arguments[1:])
        whole, byte = ir.IntType(32), cgutils.voidptr_t
        kind = ir.FunctionType(ir.VoidType(), [byte, whole, whole, whole])
        function = builder.module.declare_intrinsic("llvm.prefetch", [byte], kind)
        for_reading, keep, data = whole(0), whole(3), whole(1)
        builder.call(function, [builder.bitcast(at, byte), for_reading, keep, data])
        return context.get_dummy_value()

    return types.void(image, row, column), emit
