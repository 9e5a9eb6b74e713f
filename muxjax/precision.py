"""Which precision a call runs in.

JAX computes in float32 unless its x64 switch is on. Kinematics and planning need float64, and a
library must not flip a global switch. The rule here: **NumPy in, NumPy float64 out; JAX in, JAX
out.** A call on host data (lists, NumPy arrays) runs compiled, in a local float64 context; a call
on JAX arrays or inside a trace is an ordinary JAX function whose precision is the caller's.
"""

from __future__ import annotations

import functools
import inspect
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")
R = TypeVar("R")


def host_array(name: str, value: Any, last: int | None = None) -> np.ndarray:
    """A float64 NumPy copy of ``value``, checked.

    Args:
        name: How errors call the value.
        value: Anything array-like.
        last: Required size of the last axis, if any.

    Raises:
        ValueError: Not numeric, wrong last axis, or an entry that is not finite.
    """
    try:
        given = np.asarray(value)
        if given.dtype.kind not in "biuf":
            raise TypeError(f"found {given.dtype}")
        array = np.array(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected numbers in a regular array ({error})") from None
    if last is not None:
        check_last_axis(name, array.shape, last)
    if not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"{name}: entry {index} is {array[index]}, must be finite")
    return array


def pad_rows(rows: np.ndarray) -> np.ndarray:
    """Rows padded with zeros to 16, 64, 256, ... so that any batch shares a few compilations."""
    size = 16
    while size < len(rows):
        size *= 4
    return np.pad(rows, ((0, size - len(rows)), *((0, 0),) * (rows.ndim - 1)))


def cores() -> int:
    """Processor cores that this process may use: threads for the chunks of a batch."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_threads(work: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """``work`` of every item, in threads that compute on the caller's default device.

    JAX keeps ``jax.default_device`` for each thread.
    """
    device = jax.config.jax_default_device  # type: ignore[attr-defined]

    def there(item: T) -> R:
        with jax.default_device(device):
            return work(item)

    with ThreadPoolExecutor(cores()) as pool:
        return list(pool.map(there, items))


def on_cpu() -> bool:
    """Whether compiled calls of this thread run on a CPU: JAX's default device."""
    device = jax.config.jax_default_device  # type: ignore[attr-defined]
    if device is None:
        return jax.default_backend() == "cpu"
    return getattr(device, "platform", device) == "cpu"


def by_device(cpu: T, other: T) -> T:
    """A size for compiled calls: what suits a core's cache, or what fills a GPU.

    A GPU takes as long for a hundred rows as for ten thousand, and each call costs it more.
    """
    return cpu if on_cpu() else other


def padded_size(rows: int, cpu: Sequence[int], other: Sequence[int]) -> int:
    """The least of the device's compiled sizes that holds so many rows; else the greatest."""
    sizes = by_device(cpu, other)
    return next((size for size in sizes if size >= rows), sizes[-1])


def matmul(a: Any, b: Any) -> Any:
    """``a @ b`` in the precision of its arguments.

    By default JAX lets a GPU round the factors of a float32 product to TF32, which has 11 bits.
    MuxArm's poses were 6e-4 off by that on an H200, and are 8e-7 off in float32.
    """
    return jnp.matmul(a, b, precision="highest")


def check_last_axis(name: str, shape: tuple[int, ...], last: int) -> None:
    """Raise ValueError unless ``shape`` ends in ``last``."""
    if not shape or shape[-1] != last:
        raise ValueError(f"{name}: last axis must have {last} entries, found shape {shape}")


def numpy_in_numpy_out(*, static: Sequence[str] = ()) -> Callable[[F], F]:
    """Decorate ``fn(robot, *arrays)`` so that it follows the rule at the top of this file.

    Args:
        static: Names of arguments that are not arrays and select what is compiled.
    """

    def decorate(fn: F) -> F:
        signature = inspect.signature(fn)
        compiled = jax.jit(fn, static_argnames=tuple(static))

        @functools.wraps(fn)
        def face(robot: Any, *args: Any, **kwargs: Any) -> Any:
            if not isinstance(robot, eqx.Module):
                raise ValueError(f"robot: expected a Robot, found {type(robot).__name__}")
            bound = signature.bind(robot, *args, **kwargs)
            given = bound.arguments
            arrays = [name for name in list(given)[1:] if name not in static]
            if any(isinstance(x, jax.Array) for x in jax.tree.leaves((robot, args, kwargs))):
                given.update({name: jnp.asarray(given[name]) for name in arrays})
                return fn(*bound.args, **bound.kwargs)
            given.update({name: host_array(name, given[name]) for name in arrays})
            with jax.enable_x64(True):
                # A copy, because the view of a JAX array cannot be written to.
                return jax.tree.map(np.array, compiled(*bound.args, **bound.kwargs))

        return face  # type: ignore[return-value]

    return decorate
