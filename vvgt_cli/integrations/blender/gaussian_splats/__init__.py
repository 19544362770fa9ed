"""Blender's File menu: import Gaussian splats, and export a Volume object, with its material's ramp, to splats.

Export is the ``vvgt`` command's, and so is the import of other files than ``.ply``.

Tried: Blender 5.0.1, 5.3.0 (bpy of PyPI)
Enable:
    Edit > Preferences > Get Extensions > Repositories > + > Add Local Repository, Custom Directory: {above}
    Edit > Preferences > Add-ons: enable Gaussian Splats.
    If vvgt is not in PATH, set the environment variable VVGT to its path before Blender starts.
"""

from __future__ import annotations

import json
import tempfile
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import bpy
from bpy_extras.io_utils import ExportHelper, ImportHelper
from mathutils import Vector

FOLDER = Path(__file__).resolve().parent
NAMES = "*.html;*.ply;*.spz;*.sog;*.glb;*.usdc;*.usdz"


def _load(path: Path) -> Any:
    spec: Any = spec_from_file_location(f"vvgt_{path.stem}", path)
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


command = _load(FOLDER.parents[1] / "command.py")
splats, volume, scene_of = (_load(FOLDER / f"{name}.py") for name in ("splats", "volume", "scene"))


def imported(path: str) -> tuple[Any, list[str]]:
    """Add the Gaussians of a file, and return the object and what is not shown, or raise RuntimeError."""
    with tempfile.TemporaryDirectory() as folder:
        plain = path
        if not path.lower().endswith(".ply") or path.lower().endswith(".compressed.ply"):
            plain = str(Path(folder) / "splats.ply")
            command.run(["view", path, "-o", plain])
        made, notes = splats.add(plain, bpy.path.display_name_from_filepath(path))
    return made, notes


def converted(scene: Any, item: Any, path: str, options: list[str]) -> list[str]:
    """Convert a Volume object to a file, and return what is not taken, or raise RuntimeError."""
    with tempfile.TemporaryDirectory() as name:
        source, tf = (Path(name) / part for part in ("volume.vdb", "tf.json"))
        shown = volume.Material(item, scene_of.saved(item, source))
        said: list[str] = []
        command.run(["info", str(source), "--grid", shown.grid, "--json"], said.append)
        low, high = json.loads("".join(said[said.index("{") :]))["range"]
        function, notes = shown.function(low, high, item)
        tf.write_text(json.dumps(function), "utf-8")
        view, more = scene_of.camera_words(scene, item.matrix_world @ (sum(map(Vector, item.bound_box), Vector()) / 8))
        words = ["--grid", shown.grid, "--tf", str(tf), "--up", "z", *view, "-o", path, "--overwrite", *options]
        command.run(["convert", str(source), *words])
    return [*notes, *more]


class Splats:
    """An operator that does its ``work`` and says what it left out."""

    def execute(self: Any, context: Any) -> set[str]:
        """Do it, or report in a line why not."""
        try:
            notes = self.work(context)
        except (RuntimeError, OSError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if notes:
            self.report({"WARNING"}, f"{self.filepath} is without: {', '.join(notes)}")
        return {"FINISHED"}


class ImportSplats(Splats, bpy.types.Operator, ImportHelper):
    """Import Gaussian splats."""

    bl_idname, bl_label, bl_options = "import_scene.gaussian_splats", "Import Gaussian splats", {"UNDO"}
    __annotations__ = {  # as Blender wants properties
        "filter_glob": bpy.props.StringProperty(default=NAMES, options={"HIDDEN"}),
        "scene": bpy.props.BoolProperty(
            name="Set Up Scene", default=True,
            description="View transform Standard, which shows the file's colours; 1024 transparent bounces in Cycles",
        ),
    }  # fmt: skip

    def work(self, context: Any) -> list[str]:
        """Import the file, and return what is not shown."""
        notes = imported(self.filepath)[1]
        if self.scene:
            context.scene.view_settings.view_transform = "Standard"
            if hasattr(context.scene, "cycles"):
                context.scene.cycles.transparent_max_bounces = 1024
        return notes


class ExportSplats(Splats, bpy.types.Operator, ExportHelper):
    """Convert the active Volume object to Gaussian splats, as its material shows it."""

    bl_idname, bl_label, filename_ext = "export_scene.gaussian_splats", "Export Gaussian splats", ".html"
    check_extension = None  # any ending that vvgt writes
    __annotations__ = {
        "filter_glob": bpy.props.StringProperty(default=NAMES, options={"HIDDEN"}),
        "options": bpy.props.StringProperty(description="Of vvgt convert, such as --max-gaussians 50000"),
    }

    @classmethod
    def poll(cls, context: Any) -> bool:
        """Return whether a Volume object is active."""
        return context.object is not None and context.object.type == "VOLUME"

    def work(self, context: Any) -> list[str]:
        """Convert it, and return what is not taken."""
        return converted(context.scene, context.object, self.filepath, self.options.split())


def _entry(menu: Any, _: Any) -> None:
    kind = ImportSplats if "import" in menu.bl_idname else ExportSplats
    menu.layout.operator(kind.bl_idname, text="Gaussian splats")


CLASSES = ((ImportSplats, bpy.types.TOPBAR_MT_file_import), (ExportSplats, bpy.types.TOPBAR_MT_file_export))


def register() -> None:
    """Add both to the File menu."""
    for kind, menu in CLASSES:
        bpy.utils.register_class(kind)
        menu.append(_entry)


def unregister() -> None:
    """Remove both."""
    for kind, menu in CLASSES:
        menu.remove(_entry)
        bpy.utils.unregister_class(kind)
