"""PET in SUV by body weight: the formula of QIBA's pseudo-code by hand, in float64, and headers that lack something."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from pydicom.dataset import Dataset

from tests.refused import refused
from tests.test_volume_hospital import image, real_world, save
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume import ReadOptions, read_volume

STORED = np.random.default_rng(4).integers(0, 30000, (3, 4, 5)).astype("<i2")
HALF, DOSE, KG, SLOPE, DELAY = 6586.2, 3.7e8, 72.5, 1.25, 3600.0 + 125


def pet(folder: Path, slopes: tuple[float, ...] = (SLOPE,) * 3, injected: dict | None = None, **changes: object) -> str:
    """A series of three slices that began an hour, two minutes and five seconds after the injection."""
    for k, plane in enumerate(STORED):
        dose = Dataset()
        stated = {"RadionuclideTotalDose": DOSE, "RadionuclideHalfLife": HALF, "RadiopharmaceuticalStartTime": "101010"}
        for key, value in (stated | (injected or {})).items():
            if value is not None:
                setattr(dose, key, value)
        private = changes.pop("private", {}) if k == 2 else changes.get("private", {})
        file = image(plane, (0, 0, 3 * k), **{
            "Modality": "PT", "Units": "BQML", "DecayCorrection": "START", "CorrectedImage": ["ATTN", "DECY", "SCAT"],
            "PatientWeight": KG, "RescaleSlope": slopes[k], "RescaleIntercept": 0, "InstanceNumber": k + 1,
            "SeriesDate": "20260102", "SeriesTime": "111215", "AcquisitionDate": "20260102",
            "AcquisitionTime": f"11{12 + 3 * (2 - k)}15.5", "RadiopharmaceuticalInformationSequence": [dose],
            **{key: value for key, value in changes.items() if key != "private"},
        })  # fmt: skip
        for (group, element), (creator, vr, value) in private.items():
            file.private_block(group, creator, create=True).add_new(element, vr, value)
        save(file, folder / f"{k}.dcm")
    return str(folder)


def values(volume) -> np.ndarray:
    return volume.data.astype(np.float64) * volume.slope + volume.intercept


DECAYED = DOSE * 2.0 ** (-DELAY / HALF)
BY_WEIGHT = KG * 1000 / DECAYED


@pytest.mark.parametrize(
    ("factor", "how"),
    [
        (BY_WEIGHT, {}),
        (KG * 1000 / DOSE, {"DecayCorrection": "ADMIN", "injected": {"RadionuclideHalfLife": None}}),
        (BY_WEIGHT, {"injected": {"RadiopharmaceuticalStartDateTime": "20260102101010.00"}}),
        (KG * 1000 / DOSE * 2 ** (2 * 3600 / HALF),  # over midnight
         {"SeriesTime": "010000", "AcquisitionTime": "010001", "injected": {"RadiopharmaceuticalStartTime": "230000"}}),
        (1.0, {"Units": "GML"}),
        (2.5e-4, {"Units": "CNTS", "private": {(0x7053, 0): ("Philips PET Private Group", "DS", "0.00025")}}),
    ],
)  # fmt: skip
def test_suv_by_body_weight(tmp_path: Path, factor: float, how: dict) -> None:
    volume = read_volume(pet(tmp_path, **how))
    assert volume.value_unit == "SUVbw"
    np.testing.assert_allclose(values(volume), STORED * SLOPE * factor, rtol=1e-12)
    kept = read_volume(str(tmp_path), ReadOptions(suv="none"))
    assert kept.value_unit == {"GML": "g/ml", "CNTS": "counts"}.get(how.get("Units", ""), "Bq/ml")
    np.testing.assert_allclose(values(kept), STORED * SLOPE, rtol=1e-12)


def test_a_series_made_later_goes_by_its_frames(tmp_path: Path) -> None:
    """Its SeriesTime says nothing: the start is the acquisition, less the frame's reference time, plus its mean."""
    frame, at = 180.0, 89.0
    how = {"SeriesTime": "180000", "ActualFrameDuration": 1000 * frame, "FrameReferenceTime": 1000 * at}
    volume = read_volume(pet(tmp_path, **how))
    rate = np.log(2) / HALF
    mean = np.log(rate * frame / (1 - np.exp(-rate * frame))) / rate
    delay = 3600 + 125 + 0.5 - at + mean
    np.testing.assert_allclose(values(volume), STORED * SLOPE * KG * 1000 / DOSE * 2 ** (delay / HALF), rtol=1e-9)


def test_slices_of_several_slopes(tmp_path: Path) -> None:
    slopes = (0.5, 1.0, 2.0)
    volume = read_volume(pet(tmp_path, slopes))
    np.testing.assert_allclose(values(volume), STORED * np.reshape(slopes, (3, 1, 1)) * BY_WEIGHT, rtol=1e-6)


def test_real_world_values_are_never_multiplied_again(tmp_path: Path) -> None:
    mapped = {"RealWorldValueMappingSequence": [real_world(2.0, 0.0, "g/ml{SUVbw}")]}
    source = pet(tmp_path / "activity", (1.0,) * 3, **mapped)
    for suv, unit, factor in ((None, "SUVbw", BY_WEIGHT), ("none", "Bq/ml", 1.0)):
        with pytest.warns(UserWarning, match="its RealWorldValueMapping is not applied"):
            volume = read_volume(source, ReadOptions(suv=suv))
        assert volume.value_unit == unit
        np.testing.assert_allclose(values(volume), STORED * factor, rtol=1e-12)
    source = pet(tmp_path / "none", (1.0,) * 3, Units=None, **mapped)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        volume = read_volume(source)
    assert volume.value_unit == "g/ml{SUVbw}"
    np.testing.assert_array_equal(values(volume), 2.0 * STORED)
    refused(DataError, "leave out --suv bw", read_volume, source, ReadOptions(suv="bw"))


@pytest.mark.parametrize(
    ("how", "lacking"),
    [
        ({"PatientWeight": None}, "PatientWeight"),
        ({"PatientWeight": 0}, "PatientWeight"),
        ({"injected": {"RadionuclideTotalDose": None}}, "RadionuclideTotalDose in Bq"),
        ({"injected": {"RadionuclideTotalDose": 370}}, "RadionuclideTotalDose in Bq"),
        ({"injected": {"RadionuclideHalfLife": None}}, "RadionuclideHalfLife"),
        ({"injected": {"RadiopharmaceuticalStartTime": None}}, "RadiopharmaceuticalStartTime"),
        ({"injected": {"RadiopharmaceuticalStartDateTime": "20200102101010"}}, "at most 10 half-lives"),
        ({"DecayCorrection": "NONE"}, "DecayCorrection START or ADMIN"),
        ({"CorrectedImage": ["DECY"]}, "ATTN and DECY in CorrectedImage"),
        ({"SeriesTime": "180000"}, "SeriesTime before AcquisitionTime"),
        ({"Units": None}, "Units BQML"),
        ({"Units": "CNTS"}, r"Philips' factor \(7053,1000\)"),
        ({"Units": "GML", "SUVType": "LBM"}, "GML by body weight"),
        ({"RadiopharmaceuticalInformationSequence": None}, "RadionuclideTotalDose"),
    ],
)
def test_headers_that_lack_something_keep_activity_and_say_so(tmp_path: Path, how: dict, lacking: str) -> None:
    source = pet(tmp_path, **how)
    with pytest.warns(
        UserWarning, match=f"no SUV, for want of .*{lacking}.*; values stay (in Bq/ml|in counts|in g/ml|as stored)"
    ):
        np.testing.assert_allclose(values(read_volume(source)), STORED * SLOPE, rtol=1e-12)
    refused(DataError, "leave out --suv bw", read_volume, source, ReadOptions(suv="bw"))


def test_suv_on_the_command_line(tmp_path: Path, vvgt) -> None:
    source = pet(tmp_path / "pet")
    assert b"SUVbw" in vvgt.ok("info", source).out
    assert b"Bq/ml" in vvgt.ok("info", source, "--suv", "none").out
    few = ("--max-gaussians", 50, "--screen", 32, "--steps", 0)
    vvgt.ok("convert", source, "-o", tmp_path / "p.ply", *few)
    assert b'"SUVbw"' in (tmp_path / "p.ply").read_bytes()
    save(image(STORED[0], (0, 0, 0)), tmp_path / "mr" / "0.dcm")
    assert "no PET, but MR; leave out --suv none" in vvgt.fails(2, "info", tmp_path / "mr", "--suv", "none")
    np.save(tmp_path / "v.npy", STORED)
    assert "no DICOM PET; leave out --suv bw" in vvgt.fails(2, "info", tmp_path / "v.npy", "--suv", "bw")
    refused(UsageError, "no DICOM PET", read_volume, "example:frog", ReadOptions(suv="bw"))


def test_a_picture_without_a_place_says_what_is_missing(tmp_path: Path) -> None:
    """A secondary capture states its pixels' size, and no place."""
    save(image(STORED[0], (0, 0, 0), ImagePositionPatient=None, ImageOrientationPatient=None), tmp_path / "0.dcm")
    missing = r"no ImagePositionPatient, ImageOrientationPatient \(PixelSpacing is 0.5 x 1.5\); expected it"
    refused(DataError, missing, read_volume, str(tmp_path / "0.dcm"))
    assert read_volume(str(tmp_path / "0.dcm"), ReadOptions(spacing=(1, 1, 2))).spacing == (1, 1, 2)
