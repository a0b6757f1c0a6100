"""The anode's end of the plasma: a temperature held there, or a sheath that follows the current."""

from __future__ import annotations

from dataclasses import dataclass

from ep2sindy.thruster.checks import check_not_negative, check_positive


@dataclass(frozen=True)
class FixedAnode:
    """Electrons have this temperature at the anode's face, whatever arrives; no sheath drop."""

    T_e_eV: float = 3.0

    def __post_init__(self) -> None:
        check_positive(self, "T_e_eV")


@dataclass(frozen=True)
class AnodeSheath:
    """A sheath whose potential lets through just the electrons that the current needs.

    With n, T and j_i at the face and j_e = I_d/A - j_i, the electrons that fall on the anode by
    themselves carry j_th = e n sqrt(8 e T/(pi m_e))/4; the sheath holds back the rest:

        V_s = -T ln(min(1, j_e/j_th)), and 0 where j_e <= 0.

    The plasma at the face then stands V_s above the anode, V_0 + V_s. Of heat each electron takes
    2 T + potential_weight V_s: 1 is what a Maxwellian pays that climbs the sheath (Goebel & Katz,
    chapter 7; Hara, Plasma Sources Sci. Technol. 28 (2019) 044001); HallThruster.jl v0.22 takes 2.
    The temperature has no gradient there, but where electrons leave the anode, which have T_e_eV.
    Ions leave at sqrt((e T + k T_i)/m)/sqrt(1 + chi) or faster, T of the first cell,
    chi = exp(-x)/(sqrt(pi x) (1 + erf(sqrt(x)))), x = V_s/T (Hara 2019).
    """

    T_e_eV: float = 2.0  # of electrons from the anode, and of the first guess
    potential_weight: float = 1.0

    def __post_init__(self) -> None:
        check_positive(self, "T_e_eV")
        check_not_negative(self, "potential_weight")


Anode = FixedAnode | AnodeSheath
