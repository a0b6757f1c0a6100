"""Physical constants, each with its source."""

E_CHARGE = 1.602176634e-19  # C, exact (SI 2019)
M_ELECTRON = 9.1093837015e-31  # kg, CODATA 2018
K_BOLTZMANN = 1.380649e-23  # J/K, exact (SI 2019)
ATOMIC_MASS = 1.66053906660e-27  # kg, CODATA 2018
M_XENON = 131.293 * ATOMIC_MASS  # kg, IUPAC 2021 standard weight
