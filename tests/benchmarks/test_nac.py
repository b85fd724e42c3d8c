"""The statistics by which frames are held beside real crops."""

from datetime import datetime

import numpy as np
import pytest

from benchmarks.nac import statistics as st
from benchmarks.nac.sun import subsolar_point, sun_over, time_of
from perilune_shared.errors import UserError

SHAPE = (800, 800)


def noise(slope: float) -> np.ndarray:
    """An image of mean 1 whose power falls as frequency to the -slope; 0 gives white noise of variance 0.01."""
    white = np.random.default_rng(4).normal(0, 0.1, SHAPE)
    frequency = np.hypot(np.fft.fftfreq(SHAPE[0])[:, None], np.fft.fftfreq(SHAPE[1])[None, :])
    frequency[0, 0] = 1
    return 1 + np.fft.ifft2(np.fft.fft2(white) * frequency ** (-slope / 2)).real


def test_white_noise_has_a_flat_spectrum_of_its_variance_whatever_the_brightness():
    spectrum = st.power_spectrum(50 * noise(0))
    assert np.allclose(spectrum[6:], 0.01, rtol=0.1)
    assert abs(np.mean(np.log10(spectrum / 0.01))) < 0.05


def test_a_power_law_is_recovered():
    spectrum = st.power_spectrum(noise(2.0) - noise(2.0).mean() + 10)
    selected = st.FREQUENCY > 0.03
    slope = np.polyfit(np.log(st.FREQUENCY[selected]), np.log(spectrum[selected]), 1)[0]
    assert slope == pytest.approx(-2, abs=0.1)
    apart = st.log_difference(4 * spectrum, spectrum, 0.02, 0.4)
    assert np.allclose(apart, np.log10(4)) and 0 < len(apart) < len(spectrum)


def test_gradient_of_a_ramp_is_its_slope_over_its_mean():
    ramp = np.tile(np.linspace(10, 30, 101), (50, 1))
    assert np.allclose(st.gradients(ramp), 0.2 / 20)
    assert st.summary(ramp)["gradient_median"] == pytest.approx(0.01)


def test_summary_sees_shadow_and_skewness():
    image = np.full(SHAPE, 100.0)
    image[: SHAPE[0] // 10] = 0
    figures = st.summary(image)
    assert figures["shadow_share"] == pytest.approx(0.1)
    assert figures["std"] == pytest.approx(np.sqrt(0.1 / 0.9))
    assert figures["skewness"] == pytest.approx(-(0.9 - 0.1) / 0.3)


def test_histogram_is_a_density_and_loses_nothing():
    density = st.histogram(np.array([-1.0, 0.5, 1.5, 7.0]), np.array([0.0, 1.0, 2.0, 4.0]))
    assert density.tolist() == [0.5, 0.25, 0.125]


@pytest.mark.parametrize("comma", [",", "\t"])
def test_boxes_are_read_by_comma_and_by_tab(tmp_path, comma):
    rows = ["ID,X,Y,W,H,C_X,CY", "0,10,20,8,10,14,25", "1,-3.0,5.0,10.0,10.0,2.0,10.0", "2,-9,5,10,10,-4,10", ""]
    path = tmp_path / "boxes.txt"
    path.write_text("\r\n".join(rows).replace(",", comma))
    boxes = st.read_boxes(path)
    assert boxes.tolist() == [[10, 20, 8, 10], [-3, 5, 10, 10], [-9, 5, 10, 10]]
    # The second begins off the image and is centred in it; the third's centre lies outside.
    assert st.box_circles(boxes, 100, 100).tolist() == [[14, 25, 9], [2, 10, 10]]


@pytest.mark.parametrize("row", ["4,10,20,wide,8,1,1", "4,10,20"])
def test_a_broken_row_is_named(tmp_path, row):
    path = tmp_path / "boxes.txt"
    path.write_text("ID,X,Y,W,H,C_X,CY\n" + row)
    with pytest.raises(UserError, match="line 2"):
        st.read_boxes(path)


def test_contrast_is_that_inside_the_circle():
    image = np.full((60, 60), 100.0)
    image[20:40, 20:30], image[20:40, 30:40] = 50, 150
    found = st.crater_contrast(image, np.array([[30.0, 30.0, 16.0], [10.0, 10.0, 8.0], [2.0, 10.0, 10.0]]))
    assert found[:2].tolist() == [0.5, 0]
    assert np.isnan(found[2])


def test_counts_are_cumulative_and_for_a_million_pixels():
    counts = st.cumulative_counts(np.array([7.0, 8.0, 20.0, 40.0]), 250_000, (8, 16, 32, 64))
    assert counts.tolist() == [12, 8, 4, 0]


@pytest.mark.parametrize(
    ("name", "start"),
    [
        # Starts as their labels give them.
        ("M128963531LE.IMG", datetime(2010, 5, 20, 2, 57, 44)),
        ("M1417360906LC", datetime(2022, 9, 9, 11, 7, 18)),
        ("M1417670274_mosaic.png", datetime(2022, 9, 13, 1, 3, 26)),
    ],
)
def test_the_product_number_tells_the_time(name, start):
    assert abs((time_of(name) - start).total_seconds()) < 5


def test_other_names_tell_no_time():
    assert time_of("crop_M128963531.png") is None
    assert time_of("M12345.png") is None


def test_the_sun_is_over_the_near_side_at_full_moon_and_over_the_far_side_in_an_eclipse():
    # Lunar eclipse of 2018-07-27 and solar eclipse of 2017-08-21: Sun, Earth and Moon in line.
    latitude, longitude = subsolar_point(datetime(2018, 7, 27, 20, 22))
    # In line with the Earth, the subsolar point is the sub-Earth point, at most the librations from the middle.
    assert abs(longitude) < 8 and abs(latitude) < 1.6
    longitude = subsolar_point(datetime(2017, 8, 21, 18, 26))[1]
    assert abs(abs(longitude) - 180) < 8


def test_the_sun_moves_west_by_half_a_degree_an_hour_and_stands_overhead_where_it_should():
    time = datetime(2015, 4, 14, 12)
    latitude, longitude = subsolar_point(time)
    later = subsolar_point(datetime(2015, 4, 14, 22))[1]
    assert (longitude - later) % 360 == pytest.approx(10 * 360 / 708.7, rel=0.03)
    assert sun_over(latitude, longitude, time)[1] == pytest.approx(90, abs=1e-3)
    azimuth, elevation = sun_over(latitude, longitude - 60, time)
    assert elevation == pytest.approx(30, abs=0.1)
    assert azimuth == pytest.approx(90, abs=2)
