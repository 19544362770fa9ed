"""What the tests have ParaView do, in its own `pvpython`: show a volume, take a picture, save it by the plugin.

pvpython paraview_script.py PLUGIN VOLUME PICTURE FILE [property=value ...] [Representation.property=value ...]
"""

import ast
import inspect
import sys

inspect.getargspec = inspect.getfullargspec  # ParaView 5.11 asks for it, Python 3.11 has it no more

from paraview.simple import (  # noqa: E402  # behind that
    ColorBy,
    GetActiveViewOrCreate,
    GetColorTransferFunction,
    GetOpacityTransferFunction,
    LoadPlugin,
    OpenDataFile,
    Render,
    ResetCamera,
    SaveData,
    SaveScreenshot,
    Show,
)

plugin, volume, picture, name, *given = sys.argv[1:]
values = {key: ast.literal_eval(value) for key, value in (one.split("=", 1) for one in given)}
LoadPlugin(plugin, ns=globals())
data = OpenDataFile(volume)
view = GetActiveViewOrCreate("RenderView")
view.ViewSize = [300, 300]
view.OrientationAxesVisibility = 0
view.UseColorPaletteForBackground = 0
view.Background = [0, 0, 0]
shown = Show(data, view)
shown.Representation = "Volume"
ColorBy(shown, ("POINTS", "lump"))
shown.SetScalarBarVisibility(view, False)
colors, opacity = GetColorTransferFunction("lump"), GetOpacityTransferFunction("lump")
colors.ColorSpace = "Lab"
colors.RGBPoints = [0, 0.1, 0.2, 0.8, 0.5, 0.9, 0.8, 0.2, 1, 0.8, 0.1, 0.1]
opacity.Points = [0, 0, 0.5, 0, 0.1, 0, 0.7, 0.3, 1, 0.8, 0.5, 0]
shown.ScalarOpacityUnitDistance = 1.5
for key, value in values.items():
    if key.startswith("Representation."):
        setattr(shown, key.partition(".")[2], value)
Render()
ResetCamera()
camera = view.GetActiveCamera()
camera.Azimuth(40)
camera.Elevation(25)
Render()
SaveScreenshot(picture, view, ImageResolution=[300, 300])
sys.stdout.write(f"up {' '.join(map(str, view.CameraViewUp))}\n")  # at once, as other ranks do
sys.stdout.flush()
SaveData(name, data, **{key: value for key, value in values.items() if "." not in key})
