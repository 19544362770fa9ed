"""What the package uses of numba without a promise that it stays: each piece is where it was, with its arguments."""

import inspect
import re
from importlib import import_module
from pathlib import Path

import numba
import pytest

ROOT = Path(__file__).parent.parent
INTERNALS = ROOT / "vvgt_cli" / "jit" / "numba_internals.py"
USED = {  # "module:name": its arguments, None for what is no function
    "numba.core.bytecode:FunctionIdentity._unique_ids": None,
    "numba.core.callconv:excinfo_ptr_t": None,
    "numba.core.callconv:CPUCallConv._get_return_status": "self builder code excinfoptr",
    "numba.core.callconv:CPUCallConv.call_function": "self builder callee resty argtys args attrs",
    "numba.core.callconv:CPUCallConv.return_status_propagate": "self builder status",
    "numba.core.cgutils:alloca_once": "builder ty size name zfill",
    "numba.core.cgutils:for_range": "builder count start intp",
    "numba.core.cgutils:gep_inbounds": "builder ptr inds kws",
    "numba.core.cgutils:get_or_insert_function": "module fnty name",
    "numba.core.codegen:CodeLibrary.add_linking_library": "self library",
    "numba.core.codegen:CPUCodegen.magic_tuple": "self",
    "numba.core.codegen:JITCPUCodegen._customize_tm_options": "self options",
    "numba.core.compiler:CompileResult._rebuild": (
        "target_context libdata fndesc env signature objectmode lifted typeann reload_init referenced_envs"
    ),
    "numba.core.compiler:CompileResult._reduce": "self",
    "numba.core.compiler:Flags.no_compile": None,
    "numba.core.compiler:compile_extra": (
        "typingctx targetctx func args return_type flags locals library pipeline_class"
    ),
    "numba.core.dispatcher:Dispatcher._compile_for_args": "self args kws",
    "numba.core.registry:cpu_target.target_context.refresh": "",
    "numba.core.registry:cpu_target.typing_context.refresh": "",
    "numba.core.runtime.nrt:rtsys.initialize": "ctx",
    "numba.core.serialize:dumps": "obj",
    "numba.np.ufunc.parallel:_launch_threads": "",
}


def moved(what: str) -> str:
    return (
        f"numba {numba.__version__}: {what}. Read numba's change log, mend {INTERNALS.relative_to(ROOT)} and this list,"
        " see that tests/test_jit*.py pass, then raise the bound in pyproject.toml"
    )


@pytest.mark.parametrize("name", USED)
def test_numba_has_what_the_package_uses(name):
    module, _, path = name.partition(":")
    try:
        found = import_module(module)
        for part in path.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError) as error:
        pytest.fail(moved(f"{name} has gone ({error})"))
    if USED[name] is not None:
        arguments = " ".join(inspect.signature(found).parameters)
        assert arguments == USED[name], moved(f"{name} takes ({arguments}), not ({USED[name]})")


def test_a_dispatcher_asks_the_cache_that_is_attached_to_it():
    from vvgt_cli.jit.numba_internals import attach, forbid_calls

    class Cached:
        asked: tuple[str, ...] = ()

        def load_overload(self, signature, context):
            self.asked += ("load",)

        def save_overload(self, signature, data):
            self.asked += ("save",)

    @numba.njit
    def twice(value):
        return 2 * value

    cached = Cached()
    attach(twice, cached)
    assert twice(3) == 6
    assert cached.asked == ("load", "save"), moved(
        "a dispatcher no longer asks its _cache before and after it compiles"
    )
    forbid_calls(twice, "for kernels")
    with pytest.raises(TypeError, match="for kernels"):
        twice(2.0)


def test_numba_is_of_a_minor_release_that_the_package_allows():
    (low, high) = re.search(r'"numba>=([\d.]+),<([\d.]+)"', (ROOT / "pyproject.toml").read_text()).groups()
    own = [int(n) for n in numba.__version__.split(".")[:2]]
    least, bound = ([int(n) for n in version.split(".")] for version in (low, high))
    assert least <= own < bound, moved(f"pyproject.toml allows {low} to before {high}")


def test_one_file_uses_them():
    for path in (ROOT / "vvgt_cli").rglob("*.py"):
        found = re.findall(r"numba\.(?:core|np)\b.*", path.read_text("utf-8"))
        assert path == INTERNALS or not found, f"{path}: {found[0]} belongs in {INTERNALS.name}"
