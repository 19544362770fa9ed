"""What machine kernels are compiled for, and who may call them."""

import pytest

from tests.processes import python


def test_helpers_are_not_called_from_python():
    from vvgt_cli.splat.kernel import unit_quaternion

    with pytest.raises(TypeError, match="kernels only"):
        unit_quaternion(1, 2)


def test_vectors_are_wide_where_that_costs_no_clock(monkeypatch):
    from vvgt_cli.jit.numba_internals import config, features

    monkeypatch.setattr(config, "CPU_FEATURES", None)
    assert features("+avx512f,+avx512vbmi2") == "+avx512f,+avx512vbmi2,-prefer-256-bit"
    assert features("+avx2,+avx512f,-avx512vbmi2") == "+avx2,+avx512f,-avx512vbmi2"
    assert features("") == ""
    monkeypatch.setattr(config, "CPU_FEATURES", "+avx512vbmi2")
    assert features("+avx512vbmi2") == "+avx512vbmi2"


def test_a_worker_compiles_by_those_features(tmp_path):
    code = (
        "import llvmlite.binding as llvm; usual = llvm.Target.create_target_machine; asked = []\n"
        "def spy(self, **options): asked.append(options['features']); return usual(self, **options)\n"
        "llvm.Target.create_target_machine = spy\n"
        "from pathlib import Path; from vvgt_cli.jit import numba_internals, worker\n"
        "numba_internals.features = lambda found: found + ',-avx512vbmi2'; worker.run(Path('.'), [])\n"
        "from numba.core.registry import cpu_target; cpu_target.target_context.codegen()\n"
        "print(*(found.count(',-avx512vbmi2') for found in asked))"
    )
    counts = python("-c", code, cwd=tmp_path)[0].split()
    assert counts, "numba asked for no machine"
    assert min(map(int, counts)) >= 1
