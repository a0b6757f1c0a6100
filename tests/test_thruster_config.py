"""A thruster from a file: the group of configs, and what holds for one that cannot be."""

from pathlib import Path

import pytest
from omegaconf import OmegaConf

import ep2sindy as ep
from ep2sindy.app.schema import bind, plain
from tests.programs import ROOT, composed, ended

THRUSTERS = sorted(path.stem for path in (ROOT / "conf" / "thruster").glob("*.yaml"))


def built(*overrides: str) -> ep.thruster.Thruster:
    node = composed("+exp=breathing", *overrides).data.thruster
    return bind(plain(node), "data.thruster")()


@pytest.mark.parametrize("name", THRUSTERS)
def test_every_thruster_of_the_group_is_built(name: str) -> None:
    assert isinstance(built(f"thruster={name}"), ep.thruster.Thruster)


def test_the_default_is_the_default_of_the_class() -> None:
    assert built() == ep.thruster.Thruster()


def test_the_spt_100_has_its_published_field() -> None:
    made = built("thruster=spt100")
    assert max(made.magnetic_field.B) == pytest.approx(20.82e-3)  # at the exit
    assert made.wall == ep.thruster.wall_material("BN-SiO2", electron_scale=1.0)


def test_a_value_is_set_from_the_command_line() -> None:
    made = built("thruster=example", "data.thruster.propellant.name=argon")
    assert made.propellant == ep.thruster.propellant("argon")


@pytest.mark.parametrize("experiment", ["parametric", "pointwise"])
def test_experiments_take_a_thruster(experiment: str) -> None:
    config = composed(f"+exp={experiment}", "thruster=spt100")
    assert config.data.thruster.domain_length == 0.08
    assert "thruster" not in config


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("+data.thruster.chanel_length=0.02", r"Thruster: .*'chanel_length' \(did you mean"),
        ("data.thruster.anode._target_=ep2sindy.Anode", r"data\.thruster\.anode must name a _targ"),
    ],
)
def test_a_mistake_is_named_with_its_place(override: str, message: str) -> None:
    node = composed("+exp=breathing", "thruster=example", override).data
    with pytest.raises(ValueError, match=message):
        bind(plain(node), "data")()


OWN = """\
# @package data.thruster
_target_: ep2sindy.thruster.Thruster
channel_length: 0.02
magnetic_field:
  _target_: ep2sindy.thruster.read_magnetic_field
  path: B.csv
  exit_m: 0.02
propellant:
  _target_: ep2sindy.thruster.read_propellant
  path: rates.csv
  mass_u: 126.9
  ionization_eV: 10.45
  excitation_eV: 6.8
"""


def test_a_thruster_of_ones_own_is_found_where_one_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the field and the rates from files next to it, and no line of Python."""
    (tmp_path / "conf" / "thruster").mkdir(parents=True)
    (tmp_path / "conf" / "thruster" / "mine.yaml").write_text(OWN)
    (tmp_path / "B.csv").write_text("z_mm,B_mT\n0,1\n10,9\n20,18\n30,12\n50,2\n")
    (tmp_path / "rates.csv").write_text(
        "T_e_eV,ionization,excitation,momentum\n0.5,0,0,1e-13\n100,2e-13,9e-14,7e-13\n"
    )
    monkeypatch.chdir(tmp_path)
    assert not ended("+exp=breathing", "thruster=mine", "--cfg", "job")
    node = OmegaConf.create(capsys.readouterr().out).data.thruster
    assert node.propellant.mass_u == 126.9
    made = bind(plain(node), "data.thruster")()
    assert (made.propellant.name, made.channel_length) == ("rates", 0.02)
