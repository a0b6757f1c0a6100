"""The magnetic field: a Gaussian, and tables from files with units and without gaps."""

import numpy as np
import pytest

import ep2sindy as ep

Z = np.linspace(0.0, 0.05, 26)
PEAK = 20e-3 * np.exp(-(((Z - 0.025) / 0.012) ** 2))


def written(tmp_path, header, z, B):
    path = tmp_path / "B.csv"
    rows = [f"{a:.9g},{b:.9g}" for a, b in zip(z, B, strict=True)]
    path.write_text("\n".join(([header] if header else []) + rows) + "\n")
    return path


def test_magnetic_field_peaks_at_the_exit():
    field = ep.thruster.MagneticField().at(np.array([-0.011, 0.0, 0.018]))
    np.testing.assert_allclose(field, 15e-3 * np.exp([-0.5, 0.0, -0.5]))


@pytest.mark.parametrize(
    ("header", "z_scale", "B_scale", "given"),
    [
        ("z_m,B_T", 1.0, 1.0, {}),
        ("z_mm,B_mT", 1e3, 1e3, {}),
        ("axial position (cm), Br [G]", 1e2, 1e4, {}),
        ("", 1.0, 1.0, {}),
        ("z,B", 1e2, 1e3, {"z_unit": "cm", "B_unit": "mT"}),
    ],
)
def test_a_file_is_read_in_its_units(tmp_path, header, z_scale, B_scale, given):
    path = written(tmp_path, header, z_scale * Z, B_scale * PEAK)
    field = ep.thruster.read_magnetic_field(path, exit_m=0.025, **given)
    np.testing.assert_allclose(field.at(Z - 0.025), PEAK, rtol=1e-7)  # nine digits in the file


def test_the_curve_between_points_never_overshoots():
    table = ep.thruster.MagneticFieldTable([-2.0, -1.0, 0.0, 1.0, 2.0], [0.0, 0.0, 0.02, 0.02, 0.0])
    between = table.at(np.linspace(-2.0, 2.0, 401))
    assert between.min() >= 0.0
    assert between.max() == pytest.approx(0.02, abs=1e-15)


def test_the_curve_converges_to_the_field():
    """Third order or better for a smooth field, but for PCHIP's flat extremum: second there."""
    errors = []
    for n in (26, 51, 101):
        z = np.linspace(0.0, 0.05, n)
        B = 20e-3 * np.exp(-(((z - 0.025) / 0.012) ** 2))
        fine = np.linspace(0.005, 0.02, 500)
        exact = 20e-3 * np.exp(-(((fine - 0.025) / 0.012) ** 2))
        errors.append(np.abs(ep.thruster.MagneticFieldTable(z, B).at(fine) - exact).max())
    assert errors[0] / errors[1] > 4.0
    assert errors[1] / errors[2] > 4.0


def test_sign_and_scale_of_a_file(tmp_path):
    field = ep.thruster.read_magnetic_field(
        written(tmp_path, "z_m,B_T", Z, -PEAK), exit_m=0.025, scale=2.0
    )
    np.testing.assert_allclose(field.at(Z - 0.025), 2.0 * PEAK, rtol=1e-7)


def test_a_field_that_ends_short_of_the_domain_is_refused(tmp_path):
    inside = Z <= 0.04
    path = written(tmp_path, "z_m,B_T", Z[inside], PEAK[inside])
    field = ep.thruster.read_magnetic_field(path, exit_m=0.025)
    with pytest.raises(
        ValueError, match=r"must cover the domain, -0\.025 to 0\.025 m .* to 0\.015"
    ):
        ep.thruster.Thruster(magnetic_field=field)
    assert ep.thruster.Thruster(magnetic_field=field, domain_length=0.04).domain_length == 0.04


@pytest.mark.parametrize(
    ("text", "given", "message"),
    [
        ("z_m,B_T\n0,0.01\n0.01,\n0.02,0.01\n", {}, r"row 2 below the header .*fill the gap"),
        ("0,50\n0.05,200\n", {}, r"no unit and reaches 200, too much for T; .* B_unit=G or mT"),
    ],
)
def test_a_file_that_cannot_be_taken_says_why(tmp_path, text, given, message):
    path = tmp_path / "B.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        ep.thruster.read_magnetic_field(path, exit_m=0.025, **given)
