import numpy as np
import pytest

from btfpipe.errors import InputError
from btfpipe.sample.colour import spectrum_to_rgb

NM = np.arange(400, 701, 10.0)
# Linear Rec. 709 under D65 of spectra straight between their samples, by the CIE's own tables at 1 nm (CIE 1931 2 degree observer)
KNOWN = [
    (NM, (NM - 400) / 300, [0.808, 0.4767, 0.1362]),
    (NM, 0.1 + 0.7 * np.exp(-0.5 * ((NM - 540) / 35) ** 2), [0.0994, 0.7078, 0.1144]),
    (NM, np.where(NM < 490, 0.6, 0.05), [0.0614, 0.02, 0.6191]),
    (NM, np.where(NM > 585, 0.8, 0.1), [0.8932, 0.1061, 0.0833]),
    (NM, 0.8 - 0.7 * np.exp(-0.5 * ((NM - 530) / 40) ** 2), [0.8618, 0.176, 0.6895]),
    ([420, 480, 540, 600, 660], [0.1, 0.2, 0.5, 0.7, 0.4], [0.6873, 0.5041, 0.1143]),
]


@pytest.mark.parametrize("case", range(len(KNOWN)))
def test_spectra_have_the_colours_that_the_cies_tables_give(case):
    wavelengths, values, rgb = KNOWN[case]
    np.testing.assert_allclose(spectrum_to_rgb(wavelengths) @ values, rgb, atol=0.007)


@pytest.mark.parametrize("wavelengths", [NM, [410, 550, 690], [900, 645, 470, 530, 300]])
def test_the_same_at_all_wavelengths_is_grey(wavelengths):
    np.testing.assert_allclose(spectrum_to_rgb(wavelengths).sum(axis=1), 1, rtol=1e-12)


def test_the_order_of_wavelengths_does_not_matter_nor_a_sample_on_the_line(rng):
    values, mixed = rng.random(len(NM)), rng.permutation(len(NM))
    rgb = spectrum_to_rgb(NM) @ values
    np.testing.assert_allclose(spectrum_to_rgb(NM[mixed]) @ values[mixed], rgb, rtol=1e-12)
    more = np.append(NM, 503.7)
    between = np.append(values, np.interp(503.7, NM, values))
    np.testing.assert_allclose(spectrum_to_rgb(more) @ between, rgb, rtol=2e-3)


def test_wavelengths_that_show_no_colour_are_refused():
    with pytest.raises(InputError, match="2 of 4 wavelengths are between 400 and 700 nm"):
        spectrum_to_rgb([380, 450, 650, 900])
    with pytest.raises(InputError, match="550 nm comes twice"):
        spectrum_to_rgb([450, 550, 650, 550])
