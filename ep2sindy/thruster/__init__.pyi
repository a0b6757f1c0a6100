# Thruster
from ep2sindy.thruster.parameters import Thruster as Thruster  # for configs
from ep2sindy.thruster.parameters import OperatingPoint as OperatingPoint  # for configs
from ep2sindy.thruster.parameters import OPERATING_POINTS as OPERATING_POINTS
from ep2sindy.thruster.parameters import Background as Background  # for configs
from ep2sindy.thruster.parameters import NeutralSpeed as NeutralSpeed  # for configs
from ep2sindy.thruster.parameters import Circuit as Circuit  # for configs
from ep2sindy.thruster.parameters import ModulatedVoltage as ModulatedVoltage  # for configs
from ep2sindy.thruster.axial.simulate import simulate as simulate  # for configs
from ep2sindy.thruster.axial.starts import ColdStart as ColdStart  # for configs
from ep2sindy.thruster.axial.starts import GuessedStart as GuessedStart  # for configs
from ep2sindy.thruster.axial.starts import Restart as Restart  # for configs
from ep2sindy.thruster.axial.starts import SoftStart as SoftStart  # for configs
from ep2sindy.thruster.balance import zone_balance as zone_balance
from ep2sindy.thruster.plane.simulate import simulate_2d as simulate_2d  # for configs
from ep2sindy.thruster.propellant_files import propellant as propellant  # for configs
from ep2sindy.thruster.propellant_files import read_propellant as read_propellant  # for configs
from ep2sindy.thruster.propellants import XenonFits as XenonFits  # for configs
from ep2sindy.thruster.ionization import ionization_rate as ionization_rate  # for configs
from ep2sindy.thruster.magnetic_field import MagneticField as MagneticField  # for configs
from ep2sindy.thruster.magnetic_field import MagneticFieldTable as MagneticFieldTable  # for configs
from ep2sindy.thruster.magnetic_field import (
    read_magnetic_field as read_magnetic_field,
)  # for configs
from ep2sindy.thruster.plume import ConicalPlume as ConicalPlume  # for configs
from ep2sindy.thruster.plume import ThermalPlume as ThermalPlume  # for configs
from ep2sindy.thruster.transport import AnomalousTransport as AnomalousTransport  # for configs
from ep2sindy.thruster.transport import GaussianTransport as GaussianTransport  # for configs
from ep2sindy.thruster.transport import FunctionTransport as FunctionTransport  # for configs
from ep2sindy.thruster.transport import MultiLogTransport as MultiLogTransport  # for configs
from ep2sindy.thruster.transport import PressureShift as PressureShift  # for configs
from ep2sindy.thruster.walls import SheathWall as SheathWall  # for configs
from ep2sindy.thruster.walls import wall_material as wall_material  # for configs
from ep2sindy.thruster.walls import AnodeSheath as AnodeSheath  # for configs
from ep2sindy.thruster.walls import FixedAnode as FixedAnode  # for configs
