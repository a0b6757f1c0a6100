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
LINE = "{V_D_V: 300, mdot_mg_s: [4, 5, 6, 7]}"
FEW = "{V_D_V: 300, mdot_mg_s: [4, 5]}, {V_D_V: 310, mdot_mg_s: 4}"
STRAIGHT = ", ".join(f"{{V_D_V: {300 + 10 * k}, mdot_mg_s: {4 + k}}}" for k in range(4))


@pytest.mark.parametrize(
    ("experiment", "changes", "message"),
    [
        ("benchmark", ["n_realizations=0"], "n_realizations must be a whole number, one or more"),
        ("benchmark", ["noises=[0.1,-0.1]"], "noises[1] must be numbers, zero or more: got -0.1"),
        ("benchmark", ["variants=[our]"], "unknown variants ['our']; there are "),
        ("benchmark", ["definitions.ours.selection.gamma=-1.0"], "gamma must be zero or more"),
        ("benchmark", ["definitions.ours={_target_:builtins.dict}"], "must name a _target_"),
        ("breathing", ["depth=0"], "depth must be a whole number, one or more, got 0"),
        ("breathing", ["libraries.simple.n_norm=libary"], "must be 'library' or 'max_terms'"),
        ("breathing", ["trajectory.zone.z=[0.5,0.6]"], "a zone must hold grid points"),
        ("breathing", ["libraries.simple.variables=[n_i,q]"], "unknown variables ['q']; this fie"),
        ("constrained", ["models=null"], "models must be like {name: {terms: {x: [x, x*y]}, "),
        ("constrained", ["models.velocity.relations=null"], "velocity.relations must be a list"),
        ("constrained", ["~models.velocity.terms.n_i"], "velocity.terms must list the terms"),
        ("constrained", ["models.velocity.relations=['n_i: 2']"], "joined by one '=='"),
        ("frontier", ["variants=[STLSG]"], "unknown variants ['STLSG']; there are ['"),
        ("frontier", ["rates_Hz=[0]"], "rates_Hz[0] must be numbers, above zero: got 0"),
        ("ils", ["held_out=0.001"], "held_out=0.001 must leave 20 samples on either side"),
        ("ils", ["window=901"], "window must hold 5 samples or more and fit the first part"),
        (
            "ils",
            ["models.predator_prey.relations=['n_i: n_n == 1']"],
            "'n_n' is not in the support of 'n_i'",
        ),
        ("ils", ["+models.predator_prey.fits=[ils]"], "fits must name some of ['base', 'weak', "),
        (
            "ils",
            ["+figures.colour=1"],
            "figures, PlotRange: got an unexpected keyword argument 'colour'",
        ),
        ("parametric", ["points=[{V_D_V: 300}]"], "a point must have ['V_D_V', 'mdot_mg_s']"),
        ("parametric", ["points=[{V_D_V: a, mdot_mg_s: 5}]"], "V_D_V as a number: got 'a'"),
        ("parametric", [TWICE], "an operating point may come once: V_D_V=300, mdot_mg_s=5 comes"),
        ("parametric", ["parameters.V_D_V=null", ALIKE], "points must differ in their data: V_D"),
        ("parametric", ["parameters.V_D_V=operating_point.volts"], "volts must be there"),
        ("parametric", ["models.free.quantities.L_m.power=3"], "the power 1 or -1"),
        ("parametric", ["models.free.quantities.L_m.coefficient='n_i: 1'"], "'1' is not in"),
        ("parametric", ["windows.n_windows=0"], "windows.n_windows must be a whole number, one or"),
        ("parametric", ["law=0"], "law must be a degree of one or more, names of functions"),
        ("parametric", ["thesis.free.V_D_V=[200]"], "thesis must give ['V_D_V', 'mdot_mg_s']"),
        ("pointwise", ["bootstraps.n=0"], "a pointwise study needs bootstraps for its spread"),
        ("pointwise", ["outline.inner_radius=0.06"], "inner_radius must be below outer_radius"),
        ("pointwise", ["terms=[n_i-n_n]"], "a term is variables joined by *"),
        ("pointwise", ["terms=[n_i*B]"], "unknown variables ['B']; this field has"),
        ("pointwise", ["bootstraps.block=100000"], "no point could be fitted: a block must hold"),
        ("predict", ["models.conserving.terms.n_i=[n_i,u_iz]"], "conserving cannot hold: relation"),
        ("predict", ["models.conserving.terms.n_n=[]"], "must list the terms of every state"),
        (
            "predict",
            ["+models.conserving.known.n_n.1={flow: 4.58e22}"],
            "functions of ['V_D_V', ",
        ),
        ("predict", ["+models.conserving.relations=['n_i: n_i == n_n: n_n^2']"], "unknown term"),
        ("predict", [f"points=[{LINE}]"], "'V_D_V' is 300 at all 4 operating points; give it mor"),
        ("predict", [f"points=[{FEW}]"], "a law of 3 functions of ['V_D_V', 'mdot_mg_s'] needs m"),
        ("predict", [f"points=[{STRAIGHT}]"], "4 points do not tell the 3 terms of a law apart"),
        ("simulate", ["scan={operating_point.volts:[1]}"], "operating_point.volts must be there"),
        ("simulate", ["scan={n_cells:[]}"], "scan must be like {operating_point.voltage: [250,"),
        ("simulate", ["scan={n_cells:[30,30]}"], "each value once"),
        ("weak", ["fits.boxes.form=box"], "fits.boxes.form must be null, balance or one of ['boxe"),
        ("weak", ["models.predator_prey.terms.n_n=[q]"], "unknown variables ['q']"),
        ("weak", ["fits.boxes.n_points=[1201]"], "1201 samples were asked of 1200; lower n_points"),
        ("weak_windows", ["fits.boxes.n_points=[3001]"], "3001 samples were asked of 3000; lower"),
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
