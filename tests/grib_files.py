"""Write GRIB by ecCodes, in a process of its own: its libraries and those of other formats do not go together.

``python tests/grib_files.py FILE`` takes the messages as JSON on standard input and prints ecCodes' value nearest to
the first point of each.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

LAT, LON = np.array([30.0, 40, 50, 60]), np.array([350.0, 0, 10, 20, 30])


def field(level: float, hours: int = 0) -> np.ndarray:
    """Values (lat, lon), south to north and west to east."""
    return 1 + 2 * np.arange(5)[None, :] + 30 * LAT[:, None] + 500 * level + 7000 * hours


def message(values: np.ndarray, edition: int = 2, north_first: bool = True, **keys: Any) -> dict[str, Any]:
    """A message of values (lat, lon) that run from south to north."""
    south, north = ("Last", "First") if north_first else ("First", "Last")
    grid = {
        "Ni": 5, "Nj": 4, "iDirectionIncrementInDegrees": 10, "jDirectionIncrementInDegrees": 10, "bitsPerValue": 24,
        f"latitudeOf{north}GridPointInDegrees": 60, f"latitudeOf{south}GridPointInDegrees": 30,
        "longitudeOfFirstGridPointInDegrees": 350, "longitudeOfLastGridPointInDegrees": 30,
        "jScansPositively": int(not north_first), "dataDate": 20200101,
    }  # fmt: skip
    listed = np.ravel(values[::-1] if north_first else values).tolist()
    return {"sample": f"regular_ll_pl_grib{edition}", "keys": {**grid, **keys}, "values": listed}


def write(path: Path, *messages: dict[str, Any]) -> list[float]:
    """Write messages; ecCodes' value nearest to 30 N, 10 W of each."""
    done = subprocess.run(
        [sys.executable, __file__, str(path)], input=json.dumps(messages), capture_output=True, text=True, check=True
    )
    return [float(word) for word in done.stdout.split()]


def main() -> None:
    import eccodes

    with open(sys.argv[1], "wb") as file:
        for one in json.load(sys.stdin):
            handle = eccodes.codes_grib_new_from_samples(one["sample"])
            for key, value in one["keys"].items():
                eccodes.codes_set(handle, key, value)
            if one["values"]:
                eccodes.codes_set_values(handle, np.array(one["values"], float))
                print(eccodes.codes_grib_find_nearest(handle, 30, 350)[0].value)
            eccodes.codes_write(handle, file)


if __name__ == "__main__":
    main()
