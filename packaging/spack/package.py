"""Spack's package of vvgt.

Copy it to packages/py_vvgt/ of a Spack repository, and run in a clone of vvgt: `spack dev-build py-vvgt@0.1.0`.
"""

from spack.package import depends_on, license, run_after, version
from spack_repo.builtin.build_systems.python import PythonPackage

# what Spack's own packages lack (see packaging/README.md): installed as wheels, which needs a package index
WHEELS = ("gsply>=0.4.6", "lz4>=4.3", "OpenEXR>=3.3", "OpenImageIO>=3.2.1")


class PyVvgt(PythonPackage):
    """Converts scientific volumes to 3D Gaussian splats, with the error known."""

    license("Apache-2.0", checked_by="The vvgt developers")

    version("0.1.0")

    depends_on("python@3.11:", type=("build", "run"))
    depends_on("py-setuptools@77:", type="build")
    depends_on("py-pip", type="build")
    depends_on("py-click@8.3:", type=("build", "run"))
    depends_on("py-numba@0.61:0.68", type=("build", "run"))
    depends_on("py-numpy@1.26:", type=("build", "run"))
    depends_on("py-onnxruntime@1.20:", type=("build", "run"))
    depends_on("py-pillow@11:", type=("build", "run"))
    depends_on("py-pyvista@0.45:", type=("build", "run"))
    depends_on("py-tifffile@2025.5.10:", type=("build", "run"))

    import_modules = ("vvgt_cli",)

    @run_after("install")
    def install_wheels(self):
        """Install the dependencies that Spack does not have beside the package."""
        self.spec["python"].command(
            "-m", "pip", "install", "--no-deps", "--only-binary=:all:", "--prefix", self.prefix, *WHEELS
        )
