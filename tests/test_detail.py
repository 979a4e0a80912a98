"""How much detail images hold: against textures whose cut-off is known, and what lenses, formats and noise do."""

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from colmap_sph.stereo.detail import image_detail

SIZE = 640
Image = NDArray[np.uint8]
Floats = NDArray[Any]


def spectrum_of_texture(seed: int = 0) -> tuple[Floats, Floats, Floats]:
    """Amplitudes that fall with the frequency, as those of most scenes, and the frequencies, cycles per pixel."""
    rows = np.fft.fftfreq(SIZE)[:, None]
    columns = np.fft.rfftfreq(SIZE)[None]
    radius = np.hypot(rows, columns)
    radius[0, 0] = np.inf
    noise = np.random.default_rng(seed).normal(size=(SIZE, SIZE))
    return np.fft.rfft2(noise) / radius, rows, columns


def texture(
    cut: float = 2.0,
    blur: tuple[float, float] = (0.0, 0.0),
    noise: float = 0.0,
    seed: int = 0,
    contrast: float = 40.0,
) -> Image:
    """Nothing above `cut` times the Nyquist frequency, a Gaussian blur (rows, columns) and noise of the sensor."""
    spectrum, rows, columns = spectrum_of_texture(seed)
    spectrum = spectrum * (np.hypot(rows, columns) <= cut / 2)
    spectrum = spectrum * np.exp(-2 * np.pi**2 * ((blur[0] * rows) ** 2 + (blur[1] * columns) ** 2))
    values = np.fft.irfft2(spectrum, (SIZE, SIZE))
    return photograph(128 + contrast * values / values.std(), noise)


def photograph(values: Floats, noise: float = 0.0) -> Image:
    """Whole grey values with noise of so many."""
    noisy = values + noise * np.random.default_rng(99).normal(size=values.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("noise", [0, 1, 4])
@pytest.mark.parametrize("cut", [0.35, 0.5, 0.65, 0.8, 1.0])
def test_a_cut_off_is_found(cut: float, noise: float) -> None:
    assert image_detail(texture(cut, noise=noise)) == pytest.approx(cut, rel=0.15, abs=0.06)


@pytest.mark.parametrize("sigma", [0.5, 0.7, 1.0])
def test_a_blur_is_found(sigma: float) -> None:
    """The mean frequency of exp(-(2 π σ f)²) is 1 / (2 π^1.5 σ); that of a sharp image is a quarter."""
    assert image_detail(texture(blur=(sigma, sigma), noise=1)) == pytest.approx(2 / (np.pi**1.5 * sigma), rel=0.2)


def test_an_enlarged_image_holds_no_more() -> None:
    small = texture(0.9, noise=1)
    for factor in (1.5, 2.0):
        large = cv2.resize(small, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
        assert image_detail(large) * factor == pytest.approx(image_detail(small), rel=0.13)


def test_movement_blurs_one_direction() -> None:
    along, across, both = (image_detail(texture(blur=blur, noise=1)) for blur in ((2, 0), (0, 2), (2, 2)))
    assert along == pytest.approx(across, rel=0.1)
    assert both < 0.8 * along < 0.7 * image_detail(texture(noise=1))


@pytest.mark.parametrize("cut", [0.5, 1.0])
@pytest.mark.parametrize("quality", [60, 90])
def test_jpeg_changes_little(cut: float, quality: int) -> None:
    image = texture(cut)
    coded = cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_GRAYSCALE)
    assert image_detail(np.asarray(coded, np.uint8)) == pytest.approx(image_detail(image), rel=0.15)


def test_noise_is_no_detail() -> None:
    """Also where it grows with light: a photon counts as a grey value's eighth."""
    light = np.broadcast_to(np.linspace(40, 240, SIZE), (SIZE, SIZE))
    photons = np.random.default_rng(1).poisson(light * 8) / 8
    for image in (
        np.full((SIZE, SIZE), 90, np.uint8),
        photograph(np.full((SIZE, SIZE), 90.0), 5),
        photograph(photons),
    ):
        assert image_detail(image) < 0.4
    soft = texture(0.5).astype(np.float64)
    noisy = photograph(np.random.default_rng(2).poisson(soft * 8) / 8)
    assert image_detail(noisy) == pytest.approx(0.5, rel=0.15)


def test_noise_hides_detail() -> None:
    """Texture whose finest parts are weaker than the noise."""
    details = [image_detail(texture(noise=noise, contrast=10)) for noise in (0, 4, 12)]
    assert details[0] > 1.1 * details[1] > 1.2 * details[2]


@pytest.mark.parametrize("cut", [0.5, 1.0])
def test_what_is_blank_has_no_say(cut: float) -> None:
    values = texture(cut).astype(np.float64)
    values[:, : SIZE * 7 // 10] = 200
    assert image_detail(photograph(values, noise=2)) == pytest.approx(cut, rel=0.15)


def test_grey_values_may_have_fractions() -> None:
    image = texture(0.7)
    assert image_detail(image.astype(np.float32)) == image_detail(image)


def test_any_size() -> None:
    for shape in ((1, 1), (127, 5000), (130, 190)):
        assert image_detail(np.zeros(shape, np.uint8)) == 1
    assert image_detail(np.ascontiguousarray(texture(0.5)[:240, :320])) == pytest.approx(0.5, rel=0.15)
