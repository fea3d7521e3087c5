"""Records refuse what does not fit, in one line that names the argument."""

import numpy as np
import pytest
import scipy.sparse

from fibre import (
    Calibration,
    Defocus,
    Diversity,
    Fibrelets,
    ForwardInverse,
    GerchbergSaxton,
    Images,
    Recording,
    retrieve,
)
from fibre.propagation import transfer_function

CUBE = np.ones((3, 8, 8))


def images(**changes):
    stack = np.ones((2, 7, 8, 8))
    arguments = {
        "radiance": stack, "variance": stack, "saturated": stack > 2, "diversity": [-1e-5, 0, 1e-5],
        "steps": [0, 1, 2, 3], "times": [0, 1], "wavelength": 850e-9, "pixel_size": 1e-6,
    }  # fmt: skip
    return Images(**arguments | changes)


def calibration(**changes):
    arguments = {
        "images": images(), "inputs": scipy.sparse.csr_array(np.ones((12, 2), complex)), "points": np.zeros((6, 2)),
        "grid": (2, 3), "references": images(), "registration": np.eye(2, 3),
    }  # fmt: skip
    return Calibration(**arguments | changes)


def recording(**changes):
    arguments = {"images": images(), "illumination": np.eye(2), "blank": images(), "references": images()}
    return Recording(**arguments | changes)


def diversity(**changes):
    arguments = {"intensities": CUBE, "masks": CUBE + 0j, "wavelength": 850e-9, "pixel_size": 1e-6}
    return Diversity(**arguments | changes)


@pytest.mark.parametrize(
    ("make", "changes", "error", "text"),
    [
        (diversity, {"intensities": np.ones((8, 8))}, ValueError, "intensities must have shape"),
        (diversity, {"intensities": CUBE * np.nan}, ValueError, "intensities must be finite"),
        (diversity, {"intensities": CUBE + 0j}, TypeError, "intensities must be real"),
        (diversity, {"masks": np.ones((2, 8, 8))}, ValueError, "masks must have shape"),
        (diversity, {"masks": np.ones((3, 8, 9))}, ValueError, "masks must have shape"),
        (diversity, {"variance": np.ones((3, 8, 7))}, ValueError, "variance must have the shape of intensities"),
        (diversity, {"variance": 0 * CUBE}, ValueError, "variance must be > 0"),
        (diversity, {"wavelength": 0.0}, ValueError, "wavelength must be > 0"),
        (diversity, {"pixel_size": -1e-6}, ValueError, "pixel_size must be > 0"),
        (images, {"radiance": np.ones((2, 8, 8))}, ValueError, "radiance must have shape"),
        (images, {"radiance": np.ones((2, 6, 8, 8))}, ValueError, "radiance must have shape"),
        (images, {"variance": np.ones((2, 7, 8, 9))}, ValueError, "variance must have the shape of radiance"),
        (images, {"saturated": np.ones((1, 7, 8, 8), bool)}, ValueError, "saturated must have shape"),
        (images, {"times": [0, 1, 2]}, ValueError, "times, diversity and steps"),
        (images, {"steps": [0, 1, np.inf, 3]}, ValueError, "steps must be finite"),
        (images, {"diversity": [[0, 1, 2]]}, ValueError, "diversity must have shape"),
        (images, {"pixel_size": 0}, ValueError, "pixel_size must be > 0"),
        (calibration, {"images": CUBE}, TypeError, "images must be Images"),
        (calibration, {"references": None}, TypeError, "references must be Images"),
        (calibration, {"inputs": np.ones((12, 2))}, ValueError, "inputs must be a sparse matrix"),
        (calibration, {"inputs": scipy.sparse.csr_array((11, 2))}, ValueError, r"inputs .* \(12, 2\), got \(11, 2\)"),
        (calibration, {"grid": (2, 4)}, ValueError, "grid .* must hold all points"),
        (calibration, {"grid": (2.0, 3)}, TypeError, "grid must be an integer"),
        (calibration, {"points": np.zeros((6, 3))}, ValueError, "points must have shape"),
        (calibration, {"registration": np.eye(3)}, ValueError, "registration must have shape"),
        (recording, {"blank": CUBE}, TypeError, "blank must be Images"),
        (recording, {"illumination": np.ones((2, 3))}, ValueError, "images must have one capture per illumination"),
        (recording, {"illumination": np.ones((3, 2))}, ValueError, "illumination must have shape"),
    ],
)  # fmt: skip
def test_wrong_records_are_named_in_one_line(make, changes, error, text):
    make()  # the record is right but for the change
    with pytest.raises(error, match=text) as caught:
        make(**changes)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("call", "error", "text"),
    [
        (lambda: Fibrelets(np.zeros((3, 3)), 1e-6), ValueError, "centres must have shape"),
        (lambda: Fibrelets(np.zeros((3, 2)), 0.0), ValueError, "mode_radius must be > 0"),
        (lambda: Defocus(CUBE, [0, 1e-5], 850e-9, 1e-6), ValueError, "distances must have shape"),
        (lambda: GerchbergSaxton(iterations=0), ValueError, "iterations must be >= 1"),
        (lambda: GerchbergSaxton(averaging=2.0), TypeError, "averaging must be an integer"),
        (lambda: GerchbergSaxton(tolerance=-1.0), ValueError, "tolerance must be >= 0"),
        (lambda: ForwardInverse(window=0.0), ValueError, "window must be > 0"),
        (lambda: ForwardInverse(strength=-1.0), ValueError, "strength must be >= 0"),
        (lambda: retrieve(CUBE, GerchbergSaxton()), TypeError, "diversity must be Diversity"),
        (lambda: retrieve(diversity(), "gerchberg"), TypeError, "method must be RetrievalMethod"),
    ],
)
def test_wrong_settings_are_named(call, error, text):
    with pytest.raises(error, match=text):
        call()


def test_defocus_is_diversity_with_the_masks_of_free_space():
    made = Defocus(CUBE, [-2e-5, 0, 3e-5], 850e-9, 1e-6)
    np.testing.assert_array_equal(made.masks, transfer_function((8, 8), [-2e-5, 0, 3e-5], 850e-9, 1e-6))


def test_sizes_are_read_from_the_images():
    assert (images().captures, images().frame) == (2, (8, 8))
