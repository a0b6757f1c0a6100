"""Settings that cannot work end an experiment before it simulates, and before it keeps a model."""

import re
from pathlib import Path

import pytest
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from ep2sindy.app.runner import run_config
from tests.programs import composed
from tests.test_pages import TOYS

TWICE = "points=[{V_D_V: 300, mdot_mg_s: 5},{V_D_V: 300, mdot_mg_s: 5, data: {n_cells: 40}}]"
ALIKE = "points=[{V_D_V: 1, mdot_mg_s: 5},{V_D_V: 2, mdot_mg_s: 5}]"
FEW = "{V_D_V: 300, mdot_mg_s: [4, 5]}, {V_D_V: 310, mdot_mg_s: 4}"
HELD = "models={own: {terms: {n_i: [n_i,n_n], n_n: [n_i]}, relations: ['n_i: n_i == n_n: n_n']}}"
STRAIGHT = ", ".join(f"{{V_D_V: {300 + 10 * k}, mdot_mg_s: {4 + k}}}" for k in range(4))


@pytest.mark.parametrize(
    ("experiment", "changes", "message"),
    [
        ("benchmark", ["noises=[0.1,-0.1]"], "noises[1] must be numbers, zero or more: got -0.1"),
        ("benchmark", ["variants=[our]"], "unknown variants ['our']; there are "),
        ("breathing", ["trajectory.zone.z=[0.5,0.6]"], "a zone must hold grid points"),
        ("breathing", ["libraries.simple.variables=[n_i,q]"], "unknown variables ['q']; this fie"),
        ("constrained", ["~models.velocity.terms.n_i"], "velocity.terms must list the terms"),
        ("ils", ["held_out=0.001"], "held_out=0.001 must leave 20 samples on either side"),
        ("ils", ["window=901"], "window must hold 5 samples or more and fit the first part"),
        ("parametric", [TWICE], "an operating point may come once: V_D_V=300, mdot_mg_s=5 comes"),
        ("parametric", ["parameters.V_D_V=null", ALIKE], "points must differ in their data: V_D"),
        ("parametric", ["models.free.quantities.L_m.power=3"], "the power 1 or -1"),
        ("pointwise", ["terms=[n_i-n_n]"], "a term is variables joined by *"),
        ("pointwise", ["bootstraps.block=100000"], "no point could be fitted: a block must hold"),
        ("predict", [HELD], "models.own cannot hold: relation"),
        (
            "predict",
            ["trajectory.states=[n_i,T_e_eV]"],
            "take sustained=none for terms of any kind",
        ),
        ("predict", [f"points=[{FEW}]"], "a law of 3 functions of ['V_D_V', 'mdot_mg_s'] needs 4"),
        ("predict", [f"points=[{STRAIGHT}]"], "4 points do not tell the 3 terms of a law apart"),
        (
            "weak",
            ["fits.automatic.form=box"],
            "fits.automatic.form must be null, balance or one of ['n_points_10', ",
        ),
    ],
)
def test_settings_that_cannot_work_are_refused(
    experiment: str, changes: list[str], message: str, predator_prey: Path, tmp_path: Path
) -> None:
    toy = TOYS[experiment](predator_prey, tmp_path)
    own = [text for text in toy if not text.startswith("+exp=")]
    config = composed(f"+exp={experiment}", *own, *changes)
    refused = (ValueError, HydraException, OmegaConfBaseException)
    with pytest.raises(refused, match=re.escape(message)):
        run_config(config)
    assert not (tmp_path / "cache").exists()
    assert not list(tmp_path.glob("*/*/models"))
