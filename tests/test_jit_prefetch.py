"""Memory that is asked for ahead of time: an instruction, and no other effect."""

import numba as nb
import numpy as np

from tests.processes import python
from vvgt_cli.splat.buffer import prefetch


@nb.njit
def total(rows, order):
    found = 0.0
    for i in range(order.shape[0]):
        prefetch(rows, order[min(i + 2, order.shape[0] - 1)], 1)
        found += rows[order[i], 1]
    return found


def test_a_line_is_asked_for_and_nothing_else_changes():
    rows = np.arange(30, dtype=np.float32).reshape(10, 3)
    assert total(rows, np.array([9, 0, 4], np.int32)) == 28 + 1 + 13
    assert any("llvm.prefetch" in code for code in total.inspect_llvm().values())
    assert np.array_equal(rows, np.arange(30).reshape(10, 3))


def test_in_plain_python_nothing_is_asked_for():
    call = "from vvgt_cli.splat.buffer import prefetch; print(prefetch(None, 0, 0))"
    assert python("-c", call, variables={"NUMBA_DISABLE_JIT": "1"}) == ("None\n", "")
