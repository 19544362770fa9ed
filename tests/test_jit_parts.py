"""Loops that threads share: every turn once, the same numbers on any number of threads, failures said."""

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.processes import python
from vvgt_cli.jit.decorators import parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, iterations, next_iteration
from vvgt_cli.refine.steps import adam


@parallel_kernel("f8:1 f8:1")
def roots(thread: ThreadSlice, values: np.ndarray, out: np.ndarray) -> None:
    """Square roots; of a negative number there is none."""
    for i in iterations(thread, values.shape[0]):
        if values[i] < 0.0:
            raise ValueError("negative")
        out[i] += np.sqrt(values[i])


@parallel_kernel("f8:1 f8:1")
def roots_one_by_one(thread: ThreadSlice, values: np.ndarray, out: np.ndarray) -> None:
    """Square roots, as whoever is free takes them."""
    i = next_iteration(thread)
    while i < values.shape[0]:
        if values[i] < 0.0:
            raise ValueError("negative")
        out[i] += np.sqrt(values[i])
        i = next_iteration(thread)


@given(st.integers(1, 70), st.integers(0, 200))
def test_parts_take_every_turn_once(parts, count):
    taken = [i for part in range(parts) for i in iterations.py_func((part, parts, None), count)]
    assert taken == list(range(count))


@pytest.mark.parametrize("count", [0, 1, 2, 1001])
@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("kernel", [roots, roots_one_by_one])
def test_each_turn_is_run_once(kernel, threads, count):
    most = numba.get_num_threads()
    values, out = np.arange(count, dtype=float), np.zeros(count)
    try:
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
        kernel(values=values, out=out)
    finally:
        numba.set_num_threads(most)
    np.testing.assert_array_equal(out, np.sqrt(values))


def test_one_thread_and_all_give_the_same_bytes():
    def step(threads):
        most, rng = numba.get_num_threads(), np.random.default_rng(0)
        arrays = [rng.random(10_007).astype(np.float32) for _ in range(4)]
        try:
            numba.set_num_threads(threads)
            adam(arrays[0], arrays[1], 1e-2, 0.9, 0.99, 3, arrays[2], arrays[3])
        finally:
            numba.set_num_threads(most)
        return b"".join(array.tobytes() for array in arrays)

    assert step(1) == step(numba.config.NUMBA_NUM_THREADS)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("kernel", [roots, roots_one_by_one])
def test_what_a_part_raises_is_raised(kernel, threads):
    most = numba.get_num_threads()
    try:
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
        with pytest.raises(ValueError, match="negative"):
            kernel(np.array([1.0, 4.0, -1.0]), np.zeros(3))
    finally:
        numba.set_num_threads(most)


def test_it_takes_its_arguments_by_name_and_place_and_keeps_its_words():
    assert (roots.__name__, roots.__doc__) == ("roots", "Square roots; of a negative number there is none.")
    with pytest.raises(TypeError, match="not enough arguments"):
        roots(np.ones(2))


def test_code_is_kept_under_the_options_of_a_body():
    def twice(thread: ThreadSlice, out: np.ndarray) -> None:
        for i in iterations(thread, out.shape[0]):
            out[i] *= 2.0

    keys = [parallel_kernel("f8:1", fastmath=fast)(twice).kernel_cache.key for fast in (False, True, False)]
    assert keys[0] == keys[2] != keys[1]


@pytest.mark.parametrize("layer", ["omp", "workqueue"])
def test_numbers_do_not_depend_on_the_threading_layer(layer):
    code = (
        "import numba, numpy as np; from tests.test_jit_parts import roots, roots_one_by_one\n"
        "for kernel in (roots, roots_one_by_one):\n"
        "    values, out = np.arange(1001.0), np.zeros(1001); kernel(values, out)\n"
        "    assert (out == np.sqrt(values)).all()\n"
        "print(numba.threading_layer())"
    )
    how = {"NUMBA_THREADING_LAYER": layer, "NUMBA_NUM_THREADS": "3"}
    assert python("-W", "ignore", "-c", code, variables=how)[0].strip() == layer
